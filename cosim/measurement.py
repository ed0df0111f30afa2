"""Measurements: a controller on some noise, as an item of work for any process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple, cast

import numpy as np

from controllers import ConvergedNmpc, RtiNmpc, compile_functions
from cosim.core.plugins import ControllerSource
from cosim.core.protocols import Controller, Vector
from cosim.core.scenario import Scenario
from cosim.core.simulation import measure, simulate
from cosim.plant import FmuPlant
from cosim.workers import Item

ITEM = 20_000
"""Samples of an item, at most about."""
ITEM_SECONDS = 1.0
"""Seconds that an item may take, where one seed does not take longer."""
FEWEST = 8
"""Items of a work at least, where it is not known how long a seed takes, and there are seeds."""
Factory = Callable[[Scenario], Controller]
Indicators = dict[str, float]


class Noise(NamedTuple):
    """Noise that a controller is measured on.

    Attributes:
        seeds: of the noise.
        steps: samples on each seed that count.
        burn_in: samples before these.
        whole: whether every sample of the one seed's run is kept, and not its indicators.
    """

    seeds: tuple[int, ...]
    steps: int
    burn_in: int = 0
    whole: bool = False

    @property
    def length(self) -> int:
        """Samples of a run."""
        return self.burn_in + self.steps

    @property
    def samples(self) -> int:
        """Plant samples on all seeds."""
        return len(self.seeds) * self.length


@dataclass
class Measured:
    """What was measured.

    Attributes:
        indicators, timing: by noise seed.
        trajectory: CSV of a run that was kept sample by sample.
    """

    indicators: dict[int, Indicators] = field(default_factory=dict)
    timing: dict[int, Indicators] = field(default_factory=dict)
    trajectory: str = ""


@dataclass(frozen=True)
class MeasureItem(Item[Measured]):
    """A controller's runs on some noise.

    Attributes:
        controller: its content, or a factory(scenario).
        noise: what it meets.
        length: samples of the longest run whose figures stand beside these. It alone decides
            whether the controller is compiled, so that no digit depends on the number of seeds.
        theta: θ in place of the controller's own, (n_θ,); empty for its own.
        plant: scenario of the plant, where it is another one than the controller's.
    """

    controller: ControllerSource | Factory
    noise: Noise
    length: int
    theta: tuple[float, ...] = ()
    plant: Scenario | None = None

    def run(self) -> Measured:
        """Simulate every seed."""
        noise = self.noise
        controller = self._built()
        measured = Measured()
        with FmuPlant(self.plant or self.conditions.scenario) as plant:
            if noise.whole:
                run = simulate(plant, controller, noise.steps, noise.seeds[0])
                return Measured(trajectory=run.to_csv())
            for seed in noise.seeds:
                indicators, timing = measure(plant, controller, seed, noise.steps, noise.burn_in)
                measured.indicators[seed] = indicators
                measured.timing[seed] = timing
        return measured

    def parts(self) -> Iterator[MeasureItem]:
        """Items of about `ITEM` samples, the same ones for any number of workers."""
        return self._of_seeds(self._most_seeds())

    def first_seed(self) -> MeasureItem:
        """The first seed alone, which shows how long one takes."""
        return replace(self, noise=self.noise._replace(seeds=self.noise.seeds[:1]))

    def timed_parts(self, seconds: float | None) -> Iterator[MeasureItem]:
        """Items of at most `ITEM` samples and about `ITEM_SECONDS`: a plant may be slow.

        Args:
            seconds: that a seed takes; None where it is not known.
        """
        if seconds is None:
            most = -(-len(self.noise.seeds) // FEWEST)
        else:
            most = int(min(ITEM_SECONDS / max(seconds, 1e-9), ITEM))
        return self._of_seeds(max(1, min(most, self._most_seeds())))

    def _most_seeds(self) -> int:
        """Seeds of an item of `ITEM` samples, at least one."""
        return max(1, ITEM // self.noise.length)

    def _of_seeds(self, size: int) -> Iterator[MeasureItem]:
        """Items of so many seeds each."""
        seeds = self.noise.seeds
        for first in range(0, len(seeds), size):
            noise = self.noise._replace(seeds=seeds[first : first + size])
            yield replace(self, noise=noise)

    def _built(self) -> Controller:
        """The controller, compiled where its runs are long."""
        if not isinstance(self.controller, ControllerSource):
            return self._new()
        key = repr((self.controller, sorted(self.conditions.facts.items()), self.length))
        if key not in _kept_nmpc:
            controller = self._new()
            # Of these nothing but θ outlives a run; of a user's controller that is not known.
            if type(controller) not in (RtiNmpc, ConvergedNmpc):
                return controller
            _kept_nmpc.clear()
            _kept_nmpc[key] = cast(RtiNmpc, controller), cast(RtiNmpc, controller).theta
        nmpc, theta = _kept_nmpc[key]
        nmpc.theta = np.array(self.theta) if self.theta else theta
        return nmpc

    def _new(self) -> Controller:
        controller = built(self.controller, self.conditions.scenario)
        # By the length of the whole work, so that its parts have the same digits.
        compile_functions(controller, self.length)
        return controller


_kept_nmpc: dict[str, tuple[RtiNmpc, Vector]] = {}
"""The NMPC that was built last in this process, and its θ: to build one takes as long as some
thousand of its samples, and the files of a run are several items."""


def built(controller: ControllerSource | Factory, scenario: Scenario) -> Controller:
    """The controller for a scenario; raises what building it raises.

    Args:
        controller: its content, or a factory.
        scenario: what it controls.
    """
    if isinstance(controller, ControllerSource):
        return controller.build(scenario)
    return controller(scenario)
