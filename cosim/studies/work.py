"""The work of a study: runs, the noise that they are measured on, and a worker's part of a run.

An evaluation's worker imports only this: learning, pandas and SciPy take longer than many samples.
"""

from __future__ import annotations

import re
import signal
import threading
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from controllers import compile_functions
from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.errors import EvaluationError, StudyError
from cosim.files import temporary_folder
from cosim.plant import FmuPlant
from cosim.plant.fmi import unpack
from cosim.plugins import OURS, build_controller, code_hash, import_from
from cosim.processes import Terminated, follow_parent
from cosim.protocols import Controller
from cosim.scenario import Scenario
from cosim.simulation import measure, simulate

if TYPE_CHECKING:
    from cosim.studies.document import TrajectoryTable
    from learning.training import TrainingRun

RUNS, CHECKPOINT = "runs", "checkpoint.npz"
Figures = dict[str, Any]
Measured = dict[int, tuple[Figures, Figures]]
"""Indicators and times by noise seed."""


@dataclass(frozen=True)
class Case:
    """One point of a grid: a controller, or an algorithm with one set of settings.

    `scenarios` are names; `training_seeds` is empty for a controller. `group` is the panel of the
    figures that shows it; `against` the case that its paired difference is taken from.
    """

    name: str
    scenarios: tuple[str, ...]
    group: str
    controller: str | None = None
    algorithm: str | None = None
    samples: int = 0
    start: str = ""
    nmpc: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    training_seeds: tuple[int, ...] = ()
    against: str | None = None

    @property
    def target(self) -> str:
        """The algorithm or the controller."""
        return self.algorithm or self.controller or ""


@dataclass(frozen=True)
class TrainingTask:
    """Arguments of `learning`'s `prepare`: equal ones give equal θ on any worker."""

    algorithm: str
    scenario: Scenario
    samples: int
    settings: Mapping[str, Any]
    options: Mapping[str, Any]

    def prepare(self) -> TrainingRun:
        """The training run, checked; raises LearningError in one line."""
        from learning.training import prepare  # noqa: PLC0415

        return prepare(self.algorithm, self.scenario, self.samples, self.settings, self.options)

    def controller(self, parameters: str, theta: Sequence[float] = ()) -> Controller:
        """The greedy controller of the θ that a TOML text holds, or of another θ of its blocks."""
        problem = Problem.from_scenario(self.scenario)
        with temporary_folder("cosim-theta-") as folder:
            path = folder / "parameters.toml"
            path.write_text(parameters, "utf-8")
            found = Parameters.load(path, problem)
        found = found.with_theta(np.array(theta)) if theta else found
        return nmpc(self.scenario, found, self.options["controller"])


class Noise(NamedTuple):
    """Noise that a controller is measured on: `steps` samples on each seed, after `burn_in`.

    Kept are indicators, or with `whole` every sample. A policy of a run in operation is that of the
    sample `mark`.
    """

    seeds: tuple[int, ...]
    steps: int
    burn_in: int = 0
    whole: bool = False
    mark: int = 0

    @property
    def samples(self) -> int:
        """Plant samples on all seeds."""
        return len(self.seeds) * (self.burn_in + self.steps)


NONE = Noise((), 0)


def safe(name: str) -> str:
    """A folder's name on any system."""
    return re.sub(r"[^\w.+=()\[\]-]", "_", name)


@dataclass(frozen=True)
class RunKey:
    """A run: scenario, case, and training seed (None for a controller).

    Raises StudyError where a name is made of dots, or has a separator of folders.
    """

    scenario: str
    case: str
    seed: int | None = None

    def __post_init__(self) -> None:
        for name in (self.scenario, self.case):
            if not name.strip(". ") or "/" in name or "\\" in name:
                raise StudyError(
                    f"'{name}' cannot name a scenario, case or controller: it would name a folder "
                    "elsewhere; give it another name"
                )

    @property
    def folder(self) -> Path:
        """Where its files are, relative to the study's folder."""
        parts = [safe(self.scenario), safe(self.case)]
        return Path(RUNS, *parts, *([] if self.seed is None else [str(self.seed)]))

    def __str__(self) -> str:
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"{self.case} on {self.scenario}{seed}"


@dataclass(frozen=True)
class Run:
    """One run: a controller, or a training and its θ.

    `controller` is what `cosim.plugins.build_controller` takes, or a factory(scenario); None for a
    training. `noise` is that of its evaluations, by the file of the results; `trajectories` are
    those to keep of it; `marks` the samples of operation at which θ, or the optimum, is judged.
    """

    key: RunKey
    case: Case
    scenario: Scenario
    controller: Any
    training: TrainingTask | None
    facts: Mapping[str, Any]
    noise: Mapping[str, Noise]
    trajectories: tuple[TrajectoryTable, ...] = ()
    marks: tuple[int, ...] = ()

    @property
    def samples(self) -> int:
        """Plant samples of the run; those of greedy evaluations while training apart."""
        trained = 0 if self.training is None else self.training.samples
        return trained + sum(noise.samples for noise in self.noise.values())


@dataclass(frozen=True)
class Trained:
    """A training at its end: `status` is `finished` or `diverged: …`, `log` learning.csv,
    `parameters` θ as text, `plant_samples` all that the plant gave for it; `clock` the processor
    time in s up to each mark of operation."""

    samples: int
    status: str
    log: str
    parameters: str
    plant_samples: int
    wall_seconds: float
    clock: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Item:
    """Unit of work of one process, independent of the machine.

    Without a `file` the run's training, its checkpoint in `folder` where the workers share this
    disk. With a `file` the run's controller on some `noise`; of a training it has the θ in
    `parameters` (TOML) or another `theta`. Plug-ins are looked up in `folders`.
    """

    run: Run
    folders: tuple[str, ...]
    folder: Path | None = None
    file: str = ""
    noise: Noise = NONE
    parameters: str = ""
    theta: tuple[float, ...] = ()

    def enter(self) -> None:
        """Make plug-ins importable; raises EvaluationError on other code or another FMU here."""
        for folder in self.folders:
            import_from(Path(folder))
        facts = self.run.facts
        if (here := code_hash()) != facts["rti-cosim"]:
            raise EvaluationError(
                f"a worker runs other code ({here}) than the work was given out with "
                f"({facts['rti-cosim']}); install the same version of rti-cosim everywhere"
            )
        if (found := unpack(self.run.scenario.plant.fmu)).sha256 != facts["fmu"]:
            raise EvaluationError(
                f"FMU '{found.path}' was replaced, or is another one on this worker (SHA-256 "
                f"{found.sha256[:16]}…, not {facts['fmu'][:16]}…); what is finished is stored: put "
                "the FMU back, or begin anew with it"
            )


@dataclass(frozen=True)
class Failure:
    """A failed item: message, traceback, and the class of our own errors."""

    message: str
    traceback: str
    kind: type[Exception] | None = None

    def error(self) -> Exception:
        """The error once more; an EvaluationError for that of a plug-in."""
        if self.kind is not None and self.kind.__init__ is Exception.__init__:
            return self.kind(self.message.partition(": ")[2])
        return EvaluationError(self.message)


Outcome = Trained | Measured | str | Failure


def perform(item: Item) -> tuple[Item, Outcome]:
    """Do an item; any exception, `sys.exit` too, becomes a Failure."""
    try:
        item.enter()
        return item, _simulate(item) if item.file else _train(item.run, item.folder)
    except (KeyboardInterrupt, Terminated):
        raise
    except BaseException as error:
        text = " ".join(f"{error}".split()) or type(error).__name__
        message = f"{type(error).__name__}: {text}"
        kind = type(error) if isinstance(error, Exception) else None
        if kind is not None and kind.__module__.partition(".")[0] not in OURS:
            kind = None
        return item, Failure(message, traceback.format_exc(), kind)


def _train(run_: Run, folder: Path | None) -> Trained:
    from cosim.studies import operation  # noqa: PLC0415
    from learning.training import COLUMNS, LogRow, run_training, to_csv  # noqa: PLC0415

    assert run_.training is not None
    run, marks, begin = run_.training.prepare(), run_.marks, perf_counter()
    if marks:
        lived, status, clock, taken = operation.live(run, marks)
        log, theta = to_csv(lived), lived[-1].parameters.to_toml()
        return Trained(marks[-1], status, log, theta, taken, perf_counter() - begin, clock)
    with temporary_folder("cosim-training-") as own:
        out = folder or own
        result = run_training(run, out, resume=(out / CHECKPOINT).is_file())
    rows = result.rows
    # The log of a study starts with θ at the start, from which its increments are counted.
    start = dict.fromkeys(rows[0] if rows else COLUMNS, float("nan")) | {"samples": 0.0}
    return Trained(
        int(rows[-1]["samples"]) if rows else 0,
        result.status,
        to_csv([LogRow(start, result.start), *rows]),
        result.parameters.to_toml(),
        result.plant_samples,
        perf_counter() - begin,
    )


def _simulate(item: Item) -> Measured | str:
    run, (seeds, steps, burn_in, whole, mark) = item.run, item.noise
    scenario, factory = run.scenario, run.controller
    if mark:
        from cosim.studies.operation import optimum_at, plant_at  # noqa: PLC0415

        scenario = plant_at(scenario, mark * scenario.sampling_time)
    controller: Controller
    if run.training is not None:
        controller = run.training.controller(item.parameters, item.theta)
    elif mark:
        controller = optimum_at(run.scenario, mark)
    elif isinstance(factory, str):
        controller = build_controller(factory, scenario)
    else:
        controller = factory(scenario)
    compile_functions(controller, sum(noise.samples for noise in run.noise.values()))
    with FmuPlant(scenario) as plant:
        if whole:
            return simulate(plant, controller, steps, seeds[0]).to_csv()
        return {seed: measure(plant, controller, seed, steps, burn_in) for seed in seeds}


def begin(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end with it."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    follow_parent(parent)
