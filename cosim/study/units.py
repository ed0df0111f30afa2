"""Work units: pieces of a training, and controllers on noise; done wherever a worker is free."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from cosim.errors import StudyError
from cosim.evaluation import reuse
from cosim.evaluation.reuse import require_code, require_fmu
from cosim.kpis import indicators
from cosim.lookup import import_from
from cosim.plugins import OURS
from cosim.protocols import Controller, functions_of
from cosim.scenario import Scenario
from cosim.simulation import simulate
from cosim.study.protocols import Progress, Trainer, Training
from cosim.study.store import INDICATORS, Indicators


@dataclass(frozen=True)
class Place:
    """What every unit needs: who trains, where foreign modules are, the hash of the code, and those
    of the FMUs by their scenario's.
    """

    trainer: Trainer
    folders: tuple[str, ...]
    code: str
    fmus: Mapping[str, str]

    def enter(self, scenario: Scenario) -> None:
        """Let foreign modules be imported; raises StudyError where code or FMU are others."""
        for folder in self.folders:
            import_from(Path(folder))
        require_code(self.code, OURS, StudyError)
        require_fmu(scenario, self.fmus[scenario.hash], StudyError)


@dataclass(frozen=True)
class Advance:
    """A piece of a training: from a checkpoint to the first one after `seconds`."""

    place: Place
    training: Training
    checkpoint: bytes
    seconds: float


@dataclass(frozen=True)
class Learnt:
    """The θ that a training ended with, as text."""

    training: Training
    parameters: str


@dataclass(frozen=True)
class Simulation:
    """A controller, by name or learnt, in the closed loop for `steps` samples a seed.

    `key` is the same for units of one controller: a worker builds it once for all of them.
    """

    place: Place
    key: str
    scenario: Scenario
    controller: str | Learnt
    steps: int


@dataclass(frozen=True)
class Evaluate(Simulation):
    """Its indicators on `seeds`."""

    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Trace(Simulation):
    """Its run on one `seed`, sample by sample."""

    seed: int


@dataclass(frozen=True)
class Accompany(Simulation):
    """Its cost on the noise of a training, by its `seed`, in blocks of `block` samples."""

    seed: int
    block: int


@dataclass(frozen=True)
class Accompanied:
    """Mean cost per sample of each block; the last may be shorter."""

    seed: int
    costs: tuple[float, ...]


@dataclass(frozen=True)
class Traced:
    """A run's trajectory as CSV."""

    trajectory: str


@dataclass(frozen=True)
class Evaluated:
    """Indicators by seed, the wall time that they took, and how functions were computed at last."""

    indicators: Indicators
    wall_seconds: float
    functions: str | None = None


@dataclass(frozen=True)
class Failure:
    """A unit that raised: its message, and the traceback for whoever looks for the cause."""

    message: str
    trace: str


Unit = Advance | Evaluate | Trace | Accompany
Outcome = Progress | Evaluated | Traced | Accompanied | Failure


def perform(unit: Unit) -> Outcome:
    """Do a unit; what it gives depends on nothing but the unit. Any error becomes a Failure."""
    try:
        unit.place.enter(unit.training.scenario if isinstance(unit, Advance) else unit.scenario)
        if isinstance(unit, Advance):
            return unit.place.trainer.advance(unit.training, unit.checkpoint, unit.seconds)
        controller = _controller(unit)
        if isinstance(unit, Trace):
            plant = reuse.plant(unit.scenario)
            return Traced(simulate(plant, controller, unit.steps, unit.seed).to_csv())
        if isinstance(unit, Accompany):
            return _accompany(unit, controller)
        return _evaluate(unit, controller)
    except Exception as error:
        text = " ".join(f"{error}".split()) or type(error).__name__
        return Failure(f"{type(error).__name__}: {text}", traceback.format_exc())


def simulated(
    scenario: Scenario, controller: Controller, steps: int, seed: int
) -> dict[str, float]:
    """Indicators of a run of a controller on a scenario's plant, which this process keeps."""
    figures = indicators(simulate(reuse.plant(scenario), controller, steps, seed, residuals=False))
    return {name: figures[name] for name in INDICATORS}


def _evaluate(unit: Evaluate, controller: Controller) -> Evaluated:
    begin = perf_counter()
    found = {s: simulated(unit.scenario, controller, unit.steps, s) for s in unit.seeds}
    return Evaluated(found, perf_counter() - begin, functions_of(controller))


def _accompany(unit: Accompany, controller: Controller) -> Accompanied:
    plant = reuse.plant(unit.scenario)
    run = simulate(plant, controller, unit.steps, unit.seed, residuals=False)
    cost = run.signals["stage_cost"].values + run.signals["penalty"].values
    firsts = range(0, unit.steps, unit.block)
    means = (float(cost[first : first + unit.block].mean()) for first in firsts)
    return Accompanied(unit.seed, tuple(means))


def _controller(unit: Simulation) -> Controller:
    trainer, wanted = unit.place.trainer, unit.controller

    def build() -> Controller:
        if isinstance(wanted, Learnt):
            return trainer.policy(wanted.training, wanted.parameters)
        return trainer.controller(wanted, unit.scenario)

    return reuse.controller(unit.key, build)
