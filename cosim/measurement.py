"""Measurements: a controller on some noise, as an item of work for any process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple, cast

import numpy as np

from controllers import ConvergedNmpc, RtiNmpc, compile_functions
from controllers.factories import ControllerSource
from cosim.core.protocols import Controller, Vector
from cosim.core.scenario import Scenario
from cosim.core.simulation import after, measure, simulate
from cosim.plant import FmuPlant
from cosim.workers import Failure, Item, SamplesDone, perform

PROBE_STEPS = 10
"""Samples of the first run that shows how long a sample takes."""
PROBE_SECONDS = 0.02
"""Length of a run that shows it: in a shorter one a run's own start counts."""
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
    """Results of a measurement.

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

    def run(self, progress: SamplesDone) -> Measured:
        """Simulate every seed.

        Args:
            progress: called each second or so with the samples so far.
        """
        noise = self.noise
        controller = self._built()
        measured = Measured()
        scenario = self.plant or self.conditions.scenario
        with FmuPlant(scenario) as plant:
            if noise.whole:
                run = simulate(
                    plant,
                    controller,
                    noise.steps,
                    noise.seeds[0],
                    progress=progress,
                )
                return Measured(trajectory=run.to_csv())
            for number, seed in enumerate(noise.seeds):
                indicators, timing = measure(
                    plant,
                    controller,
                    seed,
                    noise.steps,
                    noise.burn_in,
                    progress=after(number * noise.length, progress),
                )
                measured.indicators[seed] = indicators
                measured.timing[seed] = timing
        return measured

    def parts(self, n_seeds: int) -> Iterator[MeasureItem]:
        """Items of so many seeds each, the last of the rest."""
        seeds = self.noise.seeds
        for first in range(0, len(seeds), n_seeds):
            part = seeds[first : first + n_seeds]
            noise = self.noise._replace(seeds=part)
            yield replace(self, noise=noise)

    def seconds_a_run(self) -> float:
        """Time of a run on one seed in this process, from short ones, each longer than the last.

        Raises what building and running the controller raises.
        """
        length = self.noise.length
        seed = self.noise.seeds[0]
        scenario = self.plant or self.conditions.scenario
        # A run in which a late sensor is never read is refused.
        arrivals = [sensor.delay + 1 for sensor in scenario.sensors or ()]
        steps = min(max([PROBE_STEPS, *arrivals]), length)
        while True:
            noise = Noise((seed,), steps)
            probe = replace(self, noise=noise)
            result = perform(probe).result
            if isinstance(result, Failure):
                raise result.error()
            seconds = result.timing[seed]["wall_time_s"]
            if seconds > PROBE_SECONDS or steps == length:
                return seconds / steps * length
            steps = min(5 * steps, length)

    def _built(self) -> Controller:
        """The controller, compiled where its runs are long."""
        if not isinstance(self.controller, ControllerSource):
            return self._new()
        facts = sorted(self.conditions.facts.items())
        key = repr((self.controller, facts, self.length))
        if key not in _kept_nmpc:
            controller = self._new()
            # Of these nothing but θ outlives a run; of a user's controller that is not known.
            if type(controller) not in (RtiNmpc, ConvergedNmpc):
                return controller
            nmpc = cast(RtiNmpc, controller)
            # The last one alone: items of one controller come one after the other.
            _kept_nmpc.clear()
            _kept_nmpc[key] = (nmpc, nmpc.theta)
        nmpc, own_theta = _kept_nmpc[key]
        # An item before this one may have set another.
        nmpc.theta = np.array(self.theta) if self.theta else own_theta
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
