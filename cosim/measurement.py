"""Measurements: a controller on some noise, as an item of work for any process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from controllers import compile_functions
from cosim.core.plugins import ControllerSource
from cosim.core.protocols import Controller
from cosim.core.scenario import Scenario
from cosim.core.simulation import measure, simulate
from cosim.plant import FmuPlant
from cosim.workers import Item

ITEM = 20_000
"""Samples of an item, about: a few seconds of work."""
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
        seeds = self.noise.seeds
        size = max(1, ITEM // self.noise.length)
        for first in range(0, len(seeds), size):
            noise = self.noise._replace(seeds=seeds[first : first + size])
            yield replace(self, noise=noise)

    def _built(self) -> Controller:
        if isinstance(self.controller, ControllerSource) and self.controller.theta is not None:
            return self._with_theta(self.controller)
        controller = built(self.controller, self.conditions.scenario)
        # By the length of the whole work, so that its parts have the same digits.
        compile_functions(controller, self.length)
        return controller

    def _with_theta(self, source: ControllerSource) -> Controller:
        """The NMPC of a θ; to build one takes as long as 8000 of its samples."""
        # By its content, so that no other θ or code has the same key.
        key = repr((source, sorted(self.conditions.facts.items()), self.length))
        if key not in _kept:
            # One at a time: a study goes through its θ case by case.
            _kept.clear()
            controller: Any = source.build(self.conditions.scenario)
            compile_functions(controller, self.length)
            _kept[key] = controller, controller.theta
        controller, theta = _kept[key]
        controller.theta = np.array(self.theta) if self.theta else theta
        return controller  # type: ignore[no-any-return]


_kept: dict[str, tuple[Any, Any]] = {}
"""The NMPC that was built last from a θ in this process, and that θ."""


def built(controller: ControllerSource | Factory, scenario: Scenario) -> Controller:
    """The controller for a scenario; raises what building it raises.

    Args:
        controller: its content, or a factory.
        scenario: what it controls.
    """
    if isinstance(controller, ControllerSource):
        return controller.build(scenario)
    return controller(scenario)
