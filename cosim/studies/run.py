"""Runs: what one is, a worker's part of it, its folder, and the giving out of the work.

    OUT/runs/SCENARIO/CASE/SEED/   run.json  checkpoint.npz | learning.csv parameters.toml
                                   evaluation.csv  greedy.csv  greedy-*.csv  online-*.csv
                                   trajectory-*.csv  timing.csv

Only the process that gives out the work writes tables; a worker writes the checkpoint of its
training, and its log and θ so far. A worker imports only this file: learning, pandas and SciPy,
which take longer than many samples, are imported where they are needed.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import loky
import numpy as np

from controllers import compile_functions
from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.errors import EvaluationError, StudyError
from cosim.files import read_json, temporary_folder, write_atomically
from cosim.plant import FmuPlant
from cosim.plant.fmi import unpack
from cosim.plugins import OURS, build_controller, changed, code_hash, import_from
from cosim.processes import Terminated, follow_parent, without_interrupts
from cosim.protocols import Controller, Vector
from cosim.scenario import Scenario
from cosim.simulation import measure, simulate

if TYPE_CHECKING:
    import pandas as pd

    from learning.training_run import TrainingRun

RUNS, RUN, CHECKPOINT = "runs", "run.json", "checkpoint.npz"
TRAINED = LOG, PARAMETERS = "learning.csv", "parameters.toml"
EVALUATION, GREEDY = "evaluation.csv", "greedy.csv"
FAILURE, TIMING = "failure.txt", "timing.csv"
WRITTEN = (
    CHECKPOINT, LOG, PARAMETERS, EVALUATION, GREEDY, FAILURE, TIMING,
    "trajectory-*.csv", "greedy-*.csv", "online*.csv",
)  # fmt: skip
"""Files that a run writes beside its run.json."""
INDICATORS = (
    "J", "economic_cost", "mean_violation", "violating_share", "input_effort", "failures",
)  # fmt: skip
KEY = ["seed", "steps", "burn_in"]
TYPES: dict[str, Any] = {
    **dict.fromkeys(("scenario", "case", "status", "run"), str),
    **dict.fromkeys(("training_seed", "samples", "plant_samples"), "Int64"),
    **dict.fromkeys(("steps", "burn_in"), int),
    "seed": "uint64",
}
"""Types of columns by name; all others are floats, NaN where a cell is empty."""
PAUSE = 20
"""Least time between two writes of the tables, in multiples of the time that one takes."""
ANSWER_SECONDS = 10.0
"""Time in which a scheduler answers."""
WORKER_SECONDS = 300.0
"""Time for which a cluster may be without a worker while there is work."""
ITEM = 20_000
"""Samples of an item of evaluation, about: a few seconds of work."""
ROUNDS = 3
"""Times that workers may die without having finished one item."""
Figures = dict[str, Any]
Measured = dict[int, tuple[Figures, Figures]]
"""Indicators and times by noise seed."""
Trained = tuple[str, str, Figures]
"""learning.csv and θ at the end of a training, as texts, and what run.json says of it: `status`
(`finished` or `diverged: …`), `samples`, `plant_samples`, and `timing` in s."""


def read_table(path: Path, columns: Sequence[str] = (), needed: Sequence[str] = ()) -> pd.DataFrame:
    """Columns of a CSV (default: all, the `needed` among them), `typed`; raises StudyError."""
    import pandas as pd  # noqa: PLC0415

    try:
        texts = pd.read_csv(path, dtype="string", keep_default_na=False, na_values=[""])
        return typed(texts[list(dict.fromkeys([*(columns or texts), *needed]))])
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise StudyError(f"'{path}' is missing or damaged: {error}") from None


def typed(frame: pd.DataFrame) -> pd.DataFrame:
    """A frame with the types of `TYPES`."""
    return frame.astype({name: TYPES.get(name, float) for name in frame})


def to_csv(frame: pd.DataFrame) -> str:
    """A frame as CSV; floats read back to the same bits, NaN is empty."""
    return str(frame.to_csv(index=False, lineterminator="\n"))


# What a run is


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
class Run:
    """One run of a case on a scenario: a controller, or a training with a `seed`, and its θ.

    `controller` is what `cosim.plugins.build_controller` takes, or a factory(scenario); None for a
    training. `training` holds the other arguments of `learning`'s `make_run`: equal ones give equal
    θ on any worker. `facts` are all that its results depend on, `noise` that of its evaluations, by
    the file of the results; `kept` where the study keeps a copy of a file, relative to its folder;
    `marks` the samples of operation at which θ, or the optimum, is judged.

    Raises StudyError where a name is made of dots, or has a separator of folders.
    """

    scenario: Scenario
    case: str
    facts: Mapping[str, Any]
    noise: Mapping[str, Noise]
    controller: Any = None
    seed: int | None = None
    training: Mapping[str, Any] | None = None
    kept: Mapping[str, str] = field(default_factory=dict)
    marks: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name in (self.scenario.name, self.case):
            if not name.strip(". ") or "/" in name or "\\" in name:
                raise StudyError(
                    f"'{name}' cannot name a scenario, case or controller: it would name a folder "
                    "elsewhere; give it another name"
                )

    @property
    def folder(self) -> Path:
        """Where its files are, relative to the study's folder."""
        parts = [safe(self.scenario.name), safe(self.case)]
        return Path(RUNS, *parts, *([] if self.seed is None else [str(self.seed)]))

    def __str__(self) -> str:
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"{self.case} on {self.scenario.name}{seed}"

    def prepared(self) -> TrainingRun:
        """The training, checked; raises LearningError in one line."""
        from learning.training_run import make_run  # noqa: PLC0415

        training = self.training or {}
        return make_run(
            training["algorithm"],
            self.scenario,
            training["samples"],
            training["settings"],
            **training["options"],
        )

    def policy(self, parameters: str = "") -> Any:
        """The controller; of a training the greedy one of the θ that a TOML text holds."""
        if self.training is None:
            if isinstance(self.controller, str):
                return build_controller(self.controller, self.scenario)
            return self.controller(self.scenario)
        problem = Problem.from_scenario(self.scenario)
        with temporary_folder("cosim-theta-") as folder:
            path = folder / "parameters.toml"
            path.write_text(parameters, "utf-8")
            found = Parameters.load(path, problem)
        return nmpc(self.scenario, found, self.training["options"]["controller"])

    @property
    def samples(self) -> int:
        """Plant samples of the run; those of greedy evaluations while training apart."""
        trained = 0 if self.training is None else self.training["samples"]
        return int(trained) + sum(noise.samples for noise in self.noise.values())


# A worker's part of a run


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
    from learning.log import COLUMNS, LogRow, to_csv  # noqa: PLC0415
    from learning.training import run_training  # noqa: PLC0415

    run, marks, begin = run_.prepared(), run_.marks, time.perf_counter()
    clock: Mapping[int, float] = {}
    if marks:
        rows, status, clock, taken = operation.live(run, marks)
        samples, theta = marks[-1], rows[-1].parameters
    else:
        with temporary_folder("cosim-training-") as own:
            out = folder or own
            result = run_training(run, out, resume=(out / CHECKPOINT).is_file())
        status, taken, theta = result.status, result.plant_samples, result.parameters
        samples = int(result.rows[-1]["samples"]) if result.rows else 0
        # The log of a study starts with θ at the start, from which its increments are counted.
        start = dict.fromkeys(result.rows[0] if result.rows else COLUMNS, float("nan"))
        rows = [LogRow(start | {"samples": 0.0}, result.start), *result.rows]
    seconds = {"wall_seconds": time.perf_counter() - begin, "processor_seconds": clock}
    about = {"status": status, "samples": samples, "plant_samples": taken, "timing": seconds}
    return to_csv(rows), theta.to_toml(), about


def _simulate(item: Item) -> Measured | str:
    run, (seeds, steps, burn_in, whole, mark) = item.run, item.noise
    scenario = run.scenario
    if mark:
        from cosim.studies.operation import optimum_at, plant_at  # noqa: PLC0415

        scenario = plant_at(scenario, mark * scenario.sampling_time)
    controller: Controller
    if run.training is not None:
        controller = _judging(item)
    else:
        controller = optimum_at(run.scenario, mark) if mark else run.policy()
    compile_functions(controller, sum(noise.samples for noise in run.noise.values()))
    with FmuPlant(scenario) as plant:
        if whole:
            return simulate(plant, controller, steps, seeds[0]).to_csv()
        return {seed: measure(plant, controller, seed, steps, burn_in) for seed in seeds}


_judged: dict[str, tuple[RtiNmpc, Vector]] = {}
"""The run that was judged last here: its controller and final θ."""


def _judging(item: Item) -> RtiNmpc:
    """The controller with an item's θ; to build one takes as long as 8000 of its samples."""
    key = f"{item.run} {item.run.facts} {item.run.noise} {item.parameters}"
    if key not in _judged:
        controller = item.run.policy(item.parameters)
        _judged.clear()
        _judged[key] = controller, controller.theta
    controller, final = _judged[key]
    controller.theta = np.array(item.theta) if item.theta else final
    return controller


def begin(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end with it."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    follow_parent(parent)


# The folder of a run


class RunStore:
    """The files of one run, and what it lacks.

    Files of other facts, and those that were edited or damaged, are deleted and named in
    `remarks`: only files that a run of a study writes, and only beside a run.json. Raises
    StudyError where such files lie there without one, or the folder is outside `out`.
    """

    def __init__(self, out: Path, run: Run) -> None:
        self.folder = out / run.folder
        self.remarks: list[str] = []
        """What was changed or damaged and is done anew, in words."""
        self.run = run
        self.done = 0
        """Plant samples of the run that are done."""
        self.sealed = False
        """Whether all is done, and hashed in run.json."""
        self._known: dict[str, dict[int, Figures]] = {}
        self._unwritten: set[str] = set()
        self._quiet_until = 0.0
        if not self.folder.resolve().is_relative_to(out.resolve()):
            raise StudyError(f"'{self.folder}' leads out of '{out}'; choose another --out")
        (self.folder / FAILURE).unlink(missing_ok=True)
        facts = json.loads(json.dumps(run.facts))
        self.about = self._found()
        if (before := self.about.get("facts")) != facts:
            if before is not None:
                names = ", ".join(changed(before, facts))
                self.remarks.append(f"{names} changed since these runs; they are done anew")
            for path in self._files():
                path.unlink()
            self.folder.mkdir(parents=True, exist_ok=True)
            self.about = {}
            self._note(facts=facts, status="")
        for file in run.noise:  # a damaged one is named before the work
            self.missing(file)

    def _found(self) -> dict[str, Any]:
        """run.json if it and its hashed files are intact, else {}."""
        path = self.folder / RUN
        if not path.is_file():
            if self._files():
                raise StudyError(
                    f"'{self.folder}' has no {RUN} and is no run of a study; move it away, or "
                    "choose another --out"
                )
            return {}
        try:
            about = read_json(path, f"'{path}'", StudyError)
            about["files"] = dict(about.get("files", {}))
            dict(about["facts"])
        except (StudyError, KeyError, TypeError, ValueError):
            self.remarks.append(f"'{path}' is damaged; the run is done anew")
            return {}
        for name, digest in list(about["files"].items()):
            if _digest(self.folder / name) == digest:
                continue
            self.remarks.append(f"'{self.folder / name}' is not as it was written; made anew")
            if name in TRAINED:
                return {}
            (self.folder / name).unlink(missing_ok=True)
            del about["files"][name]
        return about

    def _files(self) -> list[Path]:
        """Files of the folder that a run of a study writes, run.json apart."""
        found = sorted(self.folder.glob("*"))
        return [path for path in found if any(map(path.match, WRITTEN))]

    def _note(self, **values: Any) -> None:
        """Write values to run.json."""
        self.about = self.about | values
        text = json.dumps(self.about, indent=1, sort_keys=True) + "\n"
        write_atomically(self.folder / RUN, text)

    @property
    def status(self) -> str:
        """How the training ended; empty while it has not."""
        return str(self.about.get("status", ""))

    def indicators(self, file: str) -> dict[int, Figures]:
        """Content of a file by noise seed, of runs as long as the plan's; {} of a damaged one."""
        path, noise = self.folder / file, self._noise(file)
        if file in self._known:
            return self._known[file]
        found = self._known[file] = {}
        if path.is_file():
            wanted = () if file == TIMING else INDICATORS
            try:
                rows = read_table(path, wanted, KEY).set_index("seed")
            except StudyError:
                self.remarks.append(f"'{path}' is damaged; made anew")
                return found
            rows = rows[(rows.steps == noise.steps) & (rows.burn_in == noise.burn_in)]
            rows = rows[~rows.index.duplicated()].drop(columns=KEY[1:])
            found |= rows.to_dict("index")
        return found

    def _noise(self, file: str) -> Noise:
        return self.run.noise[EVALUATION if file == TIMING else file]

    def measured(self, file: str) -> pd.DataFrame:
        """Content of a finished run's file, a row for each noise seed, in the plan's order."""
        import pandas as pd  # noqa: PLC0415

        rows = pd.DataFrame.from_dict(self.indicators(file), "index")
        return rows.reindex(list(self._noise(file).seeds))

    def missing(self, file: str) -> tuple[int, ...]:
        """Noise seeds that a file lacks."""
        noise = self.run.noise[file]
        if noise.whole:
            return () if (self.folder / file).is_file() else noise.seeds
        return tuple(seed for seed in noise.seeds if seed not in self.indicators(file))

    def items(self, folders: tuple[str, ...], shared_disk: bool) -> Iterator[Item]:
        """What can be done now: the training, or evaluations after its end."""
        base, training, self.done = Item(self.run, folders), self.run.training, 0
        if training is not None:
            if not self.status:
                self._unseal()
                yield replace(base, folder=self.folder.absolute() if shared_disk else None)
                return
            base = replace(base, parameters=(self.folder / PARAMETERS).read_text("utf-8"))
            self.done = training["samples"]
        for file, noise in self.run.noise.items():
            missing = noise._replace(seeds=self.missing(file))
            self.done += noise.samples - missing.samples
            theta: tuple[float, ...] = ()
            if noise.mark and missing.seeds and training is not None:
                from cosim.studies.operation import theta_at  # noqa: PLC0415

                theta = theta_at((self.folder / LOG).read_text("utf-8"), noise.mark)
            size = max(1, ITEM // (noise.burn_in + noise.steps))
            for first in range(0, len(missing.seeds), size):
                part = missing._replace(seeds=missing.seeds[first : first + size])
                yield replace(base, file=file, noise=part, theta=theta)

    def take(self, item: Item, outcome: Trained | Measured | str) -> None:
        """Store the outcome of an item; of a training run.json is written last."""
        self._unseal()
        self.done += item.noise.samples
        if isinstance(outcome, str):
            write_atomically(self.folder / item.file, outcome)
        elif isinstance(outcome, tuple):
            *texts, about = outcome
            for name, text in zip(TRAINED, texts, strict=True):
                write_atomically(self.folder / name, text)
            self.done = about["samples"]
            self._note(**about, files={name: _digest(self.folder / name) for name in TRAINED})
            (self.folder / CHECKPOINT).unlink(missing_ok=True)
        else:
            parts = [(item.file, 0), *([(TIMING, 1)] if item.file == EVALUATION else [])]
            for name, part in parts:
                self.indicators(name).update({seed: pair[part] for seed, pair in outcome.items()})
                self._unwritten.add(name)
            if time.monotonic() >= self._quiet_until:
                self.flush()

    def flush(self) -> None:
        """Write the tables that have changed."""
        import pandas as pd  # noqa: PLC0415

        # A table is written whole each time: the pause keeps that a small share of the work.
        begin = time.monotonic()
        while self._unwritten:
            file = self._unwritten.pop()
            rows, noise = pd.DataFrame.from_dict(self._known[file], "index"), self._noise(file)
            rows = rows.sort_index() if file == TIMING else rows.sort_index()[list(INDICATORS)]
            for place, value in enumerate((rows.index, noise.steps, noise.burn_in)):
                rows.insert(place, KEY[place], value)
            write_atomically(self.folder / file, to_csv(rows))
        self._quiet_until = time.monotonic() + PAUSE * (time.monotonic() - begin)

    def seal(self) -> None:
        """Write the hashes of a finished run's files to run.json."""
        trained = self.run.training is None or bool(self.status)
        self.sealed = trained and not any(map(self.missing, self.run.noise))
        if self.sealed:
            self.flush()
            files = {path.name: _digest(path) for path in self._files() if path.name != TIMING}
            if self.about.get("files") != files:
                self._note(files=files)

    def _unseal(self) -> None:
        """Remove the hashes before more is written, but those of the training's own files."""
        files = self.about.get("files", {})
        if files.keys() - TRAINED:
            self._note(files={name: files[name] for name in files.keys() & TRAINED})


def _digest(path: Path) -> str:
    """SHA-256 of a file, empty where it is not there."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


# The giving out of the work

Report = Callable[[int, str, str], None]
"""Called with the plant samples done, the runs done in words, and a line about an event, or ""."""


class Runner:
    """Does what the folders of runs lack; raises StudyError if two runs have one folder."""

    def __init__(self, runs: list[Run], out: Path, folders: tuple[Path, ...], report: Report):
        self._report, self._folders = report, tuple(map(str, dict.fromkeys(folders)))
        taken: dict[str, Run] = {}
        for run in runs:  # upper and lower case are equal on some systems
            other = taken.setdefault(str(run.folder).lower(), run)
            if other is not run:
                raise StudyError(f"'{run}' and '{other}' would have one folder; rename one of them")
        self.stores = {str(run): RunStore(out, run) for run in runs}
        self.failures: dict[str, Failure] = {}
        """The first failure of each run that failed."""
        self.remarks = list(dict.fromkeys(x for s in self.stores.values() for x in s.remarks))
        """What was changed or damaged and is done anew, in words."""

    def run(self, jobs: int, scheduler: str | None) -> None:
        """Do all that is not done; failed runs do not stop the others.

        Raises EvaluationError where no worker can work.
        """
        if jobs < 1:
            raise EvaluationError(f"jobs must be at least 1, not {jobs}")
        fruitless = 0
        while items := self._missing(shared_disk=scheduler is None):
            fruitless += 1
            try:
                with closing(_outcomes(items, jobs, scheduler)) as outcomes:
                    for item, outcome in outcomes:
                        self._take(item, outcome)
                        fruitless = 0
            except BrokenProcessPool as error:
                if fruitless == ROUNDS:
                    raise EvaluationError(
                        f"the workers died {ROUNDS} times without finishing one of the work "
                        f"items left ({error}); run with --jobs 1 to see why"
                    ) from None
            finally:
                for store in self.stores.values():
                    store.flush()

    def _missing(self, shared_disk: bool) -> list[Item]:
        items: list[Item] = []
        for name, store in self.stores.items():
            if name not in self.failures and not store.sealed:
                items += store.items(self._folders, shared_disk)
                store.seal()
        self._tell("")
        return items

    def _take(self, item: Item, outcome: Outcome) -> None:
        """Store and report the outcome of an item."""
        name = str(item.run)
        store, line = self.stores[name], ""
        if isinstance(outcome, Failure):
            if name in self.failures:
                return
            self.failures[name] = outcome
            write_atomically(store.folder / FAILURE, outcome.traceback)
            self._tell(f"failed: {name}: {outcome.message}")
            return
        store.take(item, outcome)
        if isinstance(outcome, tuple):
            line = "" if store.status == "finished" else f"{name}: {store.status}"
        else:
            store.seal()
        if store.sealed:
            found, seeds = store.indicators(EVALUATION), item.run.noise[EVALUATION].seeds
            status = store.status.partition(":")[0]
            line = f"{name}: J {sum(found[seed]['J'] for seed in seeds) / len(seeds):.6g}"
            line += f", {status}" if status else ""
        self._tell(line)

    def _tell(self, line: str) -> None:
        failed = f", {len(self.failures)} failed" if self.failures else ""
        sealed = sum(store.sealed for store in self.stores.values())
        runs = f"{sealed}/{len(self.stores)} runs{failed}"
        self._report(sum(store.done for store in self.stores.values()), runs, line)


def _outcomes(
    items: list[Item], jobs: int, scheduler: str | None
) -> Generator[tuple[Item, Outcome], None, None]:
    """Do items in this process, in `jobs` processes or on a cluster, in no certain order."""
    if scheduler is not None:
        yield from _on_cluster(scheduler, items)
        return
    if jobs == 1:
        yield from map(perform, items)
        return
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    workers = loky.ProcessPoolExecutor(
        min(jobs, len(items)), initializer=begin, initargs=(os.getpid(),), env=one_thread
    )
    try:
        with without_interrupts():
            ended = [workers.submit(perform, item) for item in items]
        for future in loky.as_completed(ended):
            yield future.result()
    finally:
        workers.shutdown(wait=True, kill_workers=True)


def _on_cluster(address: str, items: list[Item]) -> Iterator[tuple[Item, Outcome]]:
    """Run items on an existing scheduler's workers; yield them as they end.

    Raises EvaluationError where the scheduler fails, is silent or has no worker, and where a worker
    cannot do an item.
    """
    try:
        dask: Any = import_module("distributed")
    except ImportError:
        raise EvaluationError(
            "a Dask scheduler needs the extra 'cluster': pip install 'rti-cosim[cluster]'"
        ) from None
    ended: SimpleQueue[Any] = SimpleQueue()
    level = logging.root.manager.disable
    logging.disable()  # the exception says what went wrong, once
    try:
        # Ask the address first: a client made where nobody answers can hang when it ends.
        if _identity(dask, address).get("type") != "Scheduler":
            raise OSError("what answers is no scheduler")
        client = dask.Client(address, timeout=f"{ANSWER_SECONDS} s", set_as_default=False)
        try:
            for future in client.map(perform, items, pure=False):
                future.add_done_callback(ended.put)
            worked = time.monotonic()
            for _ in items:
                while True:
                    with suppress(Empty):
                        future = ended.get(timeout=ANSWER_SECONDS)
                        break
                    if _identity(dask, address)["workers"]:
                        worked = time.monotonic()
                    elif time.monotonic() - worked > WORKER_SECONDS:
                        raise OSError(f"it has had no worker for {WORKER_SECONDS:g} s")
                yield future.result()
        finally:
            with suppress(Exception):
                client.close(timeout=ANSWER_SECONDS)
    except Exception as error:
        text = f"no answer within {ANSWER_SECONDS:g} s" if type(error) is TimeoutError else error
        said = " ".join(str(text).split())[:300] or type(error).__name__
        raise EvaluationError(
            f"the Dask cluster at '{address}' failed: {said}; what is finished is stored: give the "
            "same command again, with the same rti-cosim and what the items need on all workers"
        ) from None
    finally:
        logging.disable(level)


def _identity(dask: Any, address: str) -> dict[str, Any]:
    """A scheduler's identity; raises TimeoutError without an answer."""
    import asyncio  # noqa: PLC0415 - of no use to a worker

    async def ask() -> dict[str, Any]:
        security = dask.Security().get_connection_args("client")
        async with (
            asyncio.timeout(ANSWER_SECONDS),
            dask.rpc(address, connection_args=security) as scheduler,
        ):
            return dict(await scheduler.identity())

    return asyncio.run(ask())
