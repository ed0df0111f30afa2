"""Execute the runs of a study: jobs, worker functions, run folders, scheduling.

    OUT/runs/SCENARIO/CASE/SEED/   run.json  checkpoint.npz | learning.csv parameters.toml
                                   evaluation.csv  greedy.csv  greedy-*.csv  online-*.csv
                                   trajectory-*.csv  timing.csv

Only the process that gives out the work writes tables; a worker writes the checkpoint of its
training, and its log and θ so far. A worker imports only this file: learning and pandas, which take
longer than many samples, are imported where they are needed.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from controllers.factories import ControllerSource
from controllers.functions import COMPILED, INTERPRETED, LONG, switch
from cosim.core.errors import StudyError
from cosim.core.files import read_json, temporary_folder, write_atomically
from cosim.core.modules import UNKNOWN
from cosim.core.scenario import Scenario
from cosim.core.training_options import CHECKPOINT, LOG, PARAMETERS, TrainingOptions
from cosim.evaluation import EVALUATION, ITEM_SAMPLES, TIMING, Progress
from cosim.identity import changed, file_hash
from cosim.measurement import Factory, Measured, MeasureItem, Noise
from cosim.plant.fmi import steps_are_fast
from cosim.workers import Conditions, Failure, Item, SamplesDone, done

if TYPE_CHECKING:
    import pandas as pd

    from learning.evaluator import KnownCosts
    from learning.log import LogRow
    from learning.training_run import TrainingRun

RUNS_FOLDER = "runs"
RUN_FILE = "run.json"
TRAINED = (LOG, PARAMETERS)
"""Files of a finished training."""
GREEDY = "greedy.csv"
FAILURE = "failure.txt"
RUN_FILES = (
    CHECKPOINT,
    LOG,
    PARAMETERS,
    EVALUATION,
    GREEDY,
    FAILURE,
    TIMING,
    "trajectory-*.csv",
    "greedy-*.csv",
    "online*.csv",
)
"""Files that a run writes beside its run.json."""
INDICATORS = (
    "J",
    "economic_cost",
    "mean_violation",
    "violating_share",
    "input_effort",
    "failures",
)
NOISE_KEY = ["seed", "steps", "burn_in"]
"""Columns that say what noise a row was measured on."""
TYPES: dict[str, Any] = {
    "scenario": str,
    "case": str,
    "status": str,
    "run": str,
    "training_seed": "Int64",
    "samples": "Int64",
    "plant_samples": "Int64",
    "steps": int,
    "burn_in": int,
    "seed": "uint64",
}
"""Types of columns by name; all others are floats, NaN where a cell is empty."""
SAMPLES_OF_ITEM = 20_000
"""Samples of an item of an evaluation, about: some seconds where nothing is compiled.

Where code of others runs it is `cosim.evaluation.ITEM_SAMPLES`.
"""
PAUSE = 20
"""Least time between two writes of the tables, in multiples of the time that one takes."""
TRAINING = ""
"""Stands for the training where a job is named by the file of its result."""


def read_table(
    path: Path,
    columns: Sequence[str] = (),
    needed: Sequence[str] = (),
) -> pd.DataFrame:
    """Read a CSV, its columns `typed`.

    Args:
        path: of the file.
        columns: what is read; default: all.
        needed: what must be there beside.

    Raises:
        StudyError: the file is missing or damaged.
    """
    import pandas as pd  # noqa: PLC0415

    try:
        # As texts: an empty cell alone is missing, not a case called NA.
        texts = pd.read_csv(
            path,
            dtype="string",
            keep_default_na=False,
            na_values=[""],
        )
        names = list(columns or texts)
        for name in needed:
            if name not in names:
                names.append(name)
        return typed(texts[names])
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise StudyError(f"'{path}' is missing or damaged: {error}") from None


def typed(frame: pd.DataFrame) -> pd.DataFrame:
    """A frame with the types of `TYPES`."""
    types = {name: TYPES.get(name, float) for name in frame}
    return frame.astype(types)


def frame_csv(frame: pd.DataFrame) -> str:
    """A frame as CSV; floats read back to the same bits, NaN is empty."""
    return str(frame.to_csv(index=False, lineterminator="\n"))


# What a run is


def folder_name(name: str) -> str:
    """Replace characters that some file systems refuse in a name by `_`."""
    return re.sub(r"[^\w.+=()\[\]-]", "_", name)


@dataclass(frozen=True)
class TrainingJob:
    """A training by its content: what `learning`'s `make_run` takes, but for the scenario.

    Attributes:
        algorithm: a registered name, or `module:Class`.
        samples: plant samples.
        options: seed, start and all else that is chosen of it.
        theta: text of the θ file where θ starts; None for a start with a name.
        settings: the algorithm's hyperparameters by name, as its configuration takes them.
        marks: in operation, the samples after which θ is evaluated; else empty.
    """

    algorithm: str
    samples: int
    options: TrainingOptions
    theta: str | None
    settings: Mapping[str, object]
    marks: tuple[int, ...] = ()

    def make_run(self, scenario: Scenario) -> TrainingRun:
        """The training on a scenario; raises what is wrong with it."""
        from learning.training_run import make_run  # noqa: PLC0415

        return make_run(self.algorithm, scenario, self.samples, self.settings, self.options)

    def facts(self, start: str) -> dict[str, Any]:
        """Inputs of the training's result, with the start as the study's file names it."""
        return {
            "algorithm": self.algorithm,
            "samples": self.samples,
            "settings": dict(self.settings),
            "options": asdict(replace(self.options, start=start)),
        }


@dataclass(frozen=True)
class Run:
    """One run of a case on a scenario: a controller, or a training with a `seed`, and its θ.

    Attributes:
        conditions: its scenario, and what its workers must find.
        case: name of the case.
        facts: all that its results depend on, for the next study in this folder.
        noise: noise of its evaluations, by the file of their results.
        controller: what is evaluated as it is; None for a training.
        seed: seed of the training.
        training: the training; None for a controller.
        kept: where the study keeps a copy of a file, relative to its folder.
        marks: samples of operation at which a file's policy and plant are taken, by file.

    Raises StudyError where a name is made of dots, or has a separator of folders.
    """

    conditions: Conditions
    case: str
    facts: Mapping[str, Any]
    noise: Mapping[str, Noise]
    controller: ControllerSource | Factory | None = None
    seed: int | None = None
    training: TrainingJob | None = None
    kept: Mapping[str, str] = field(default_factory=dict)
    marks: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (self.scenario.name, self.case):
            is_dots = not name.strip(". ")
            if is_dots or "/" in name or "\\" in name:
                raise StudyError(
                    f"'{name}' cannot name a scenario, case or controller: it would name a folder "
                    "elsewhere; give it another name"
                )

    @property
    def scenario(self) -> Scenario:
        """The scenario."""
        return self.conditions.scenario

    @property
    def folder(self) -> Path:
        """Folder of its files, relative to the study's."""
        scenario = folder_name(self.scenario.name)
        folder = Path(RUNS_FOLDER, scenario, folder_name(self.case))
        return folder if self.seed is None else folder / str(self.seed)

    def __str__(self) -> str:
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"{self.case} on {self.scenario.name}{seed}"

    def source(self, parameters: str) -> ControllerSource | Factory:
        """The controller; of a training the NMPC of the θ that a TOML text holds."""
        if self.training is not None:
            return ControllerSource(PARAMETERS, parameters, self.training.options.controller)
        assert self.controller is not None
        return self.controller

    @property
    def samples(self) -> int:
        """Plant samples of the run; those of greedy evaluations while training apart."""
        evaluated = sum(noise.samples for noise in self.noise.values())
        if self.training is None:
            return evaluated
        return self.training.samples + evaluated

    @property
    def length(self) -> int:
        """Samples of the longest run among its evaluations."""
        return max(noise.length for noise in self.noise.values())


def functions_for(noise: Mapping[str, Noise]) -> str:
    """How controllers of these evaluations compute, `compiled` or `interpreted`.

    The two agree but for last digits, which are not to differ among the rows of one table.
    """
    longest = max(evaluation.length for evaluation in noise.values())
    # A short run does not repay the compiler's time.
    if longest >= LONG and switch() != "never":
        return COMPILED
    return INTERPRETED


# A worker's part of a run


@dataclass(frozen=True)
class Trained:
    """Result of a training.

    Attributes:
        log: learning.csv as text.
        parameters: θ file as text.
        status: `finished` or `diverged: …`.
        samples: samples of the training that were done.
        plant_samples: samples that were taken of the plant.
        wall_seconds: time that the training took, in s.
        processor_seconds: in operation the processor's time up to each mark, in s.
    """

    log: str
    parameters: str
    status: str
    samples: int
    plant_samples: int
    wall_seconds: float = 0.0
    processor_seconds: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TrainItem(Item[Trained]):
    """A training as an item of work.

    Attributes:
        training: what is done.
        folder: of its checkpoint, where the workers share this disk.
    """

    training: TrainingJob
    folder: Path | None

    def run(self, progress: SamplesDone) -> Trained:
        """Train, from the checkpoint if there is one.

        Args:
            progress: called with the samples so far at each row of the log, in operation never.
        """
        clock = time.perf_counter()
        training = self.training
        with temporary_folder("cosim-training-") as folder:
            if training.theta is not None:
                # As text in the job, so that the worker needs no file of the study.
                start = folder / "start.toml"
                start.write_text(training.theta, "utf-8")
                options = replace(training.options, start=str(start))
                training = replace(training, options=options)
            run = training.make_run(self.conditions.scenario)
            if training.marks:
                trained = _train_in_operation(run, training.marks)
            else:
                trained = _train_in_episodes(run, self.folder or folder, progress)
        return replace(trained, wall_seconds=time.perf_counter() - clock)


def _train_in_operation(run: TrainingRun, marks: Sequence[int]) -> Trained:
    """Train from one plant sample to the next."""
    from cosim.studies.operation import run_in_operation  # noqa: PLC0415
    from learning.log import to_csv  # noqa: PLC0415

    done = run_in_operation(run, marks)
    last_row = done.rows[-1]
    return Trained(
        log=to_csv(done.rows),
        parameters=last_row.parameters.to_toml(),
        status=done.status,
        samples=marks[-1],
        plant_samples=done.plant_samples,
        processor_seconds=done.processor_seconds,
    )


def _train_in_episodes(run: TrainingRun, folder: Path, progress: SamplesDone) -> Trained:
    """Train as `cosim train` does it, with the checkpoint in a folder."""
    from learning.log import to_csv  # noqa: PLC0415
    from learning.training import run_training  # noqa: PLC0415

    has_checkpoint = (folder / CHECKPOINT).is_file()

    def show(samples: int, row: LogRow) -> None:
        progress(samples)

    # The plant of a file may be replaced while this process lives.
    known = _known_costs if steps_are_fast(run.scenario.plant.fmu) else None
    result = run_training(run, folder, resume=has_checkpoint, progress=show, known=known)
    last_row = result.rows[-1]
    return Trained(
        log=to_csv(result.rows),
        # A study reports what the rule learned, be it worse than the start.
        parameters=result.learned.to_toml(),
        status=result.status,
        # A run that diverged ends early.
        samples=int(last_row["samples"]),
        plant_samples=result.plant_samples,
    )


_known_costs: KnownCosts = {}
"""Costs of naive and of starts on held-out noise, which the runs of a process have in common."""

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
        """Changed or damaged work that is done again, in words."""
        self.run = run
        self.done = 0
        """Plant samples of the run that are done."""
        self.complete = False
        """Whether all is done, and hashed in run.json."""
        self._measured: dict[str, dict[int, dict[str, Any]]] = {}
        self._unwritten: set[str] = set()
        self._quiet_until = 0.0
        # A link could lead anywhere, and what is damaged is deleted.
        if not self.folder.resolve().is_relative_to(out.resolve()):
            raise StudyError(f"'{self.folder}' leads out of '{out}'; choose another --out")
        # Of an attempt before this one.
        (self.folder / FAILURE).unlink(missing_ok=True)
        self.about = self._intact_run_file()
        if self._is_of_other_facts():
            for path in self._files():
                path.unlink()
            self.folder.mkdir(parents=True, exist_ok=True)
            self.about = {}
            self._note(facts=self._facts(), status="")
        # A damaged one is named before the work.
        for file in run.noise:
            self.missing(file)

    def _facts(self) -> dict[str, Any]:
        """The run's facts as run.json holds them."""
        return dict(json.loads(json.dumps(self.run.facts)))

    def _is_of_other_facts(self) -> bool:
        """Whether the folder's files do not hold for the run, or cannot be known to; say why."""
        before = self.about.get("facts")
        facts = self._facts()
        if before is None:
            return True
        if before != facts:
            names = ", ".join(changed(before, facts))
            self.remarks.append(f"{names} changed since these runs; they are done again")
            return True
        unknown = [name for name, value in facts.items() if value == UNKNOWN]
        if unknown:
            names = ", ".join(unknown)
            self.remarks.append(f"the code of {names} cannot be known: {self.run} is done again")
            return True
        return False

    def _intact_run_file(self) -> dict[str, Any]:
        """run.json if it and its hashed files are intact, else {}."""
        about = self._read_run_file()
        for name, digest in list(about.get("files", {}).items()):
            path = self.folder / name
            if file_hash(path) == digest:
                continue
            self.remarks.append(f"'{path}' is not as it was written; made again")
            # Without its training no evaluation of the run holds.
            if name in TRAINED:
                return {}
            path.unlink(missing_ok=True)
            del about["files"][name]
        return about

    def _read_run_file(self) -> dict[str, Any]:
        """run.json; {} if it is damaged or there is no file of the run.

        Raises StudyError where files lie there without it.
        """
        path = self.folder / RUN_FILE
        if not path.is_file():
            if self._files():
                raise StudyError(
                    f"'{self.folder}' has no {RUN_FILE} and is no run of a study; move it away, or "
                    "choose another --out"
                )
            return {}
        try:
            about = read_json(path, f"'{path}'", StudyError)
            about["files"] = dict(about.get("files", {}))
            about["facts"] = dict(about["facts"])
        except (StudyError, KeyError, TypeError, ValueError):
            self.remarks.append(f"'{path}' is damaged; the run is done again")
            return {}
        return about

    def _files(self) -> list[Path]:
        """Files of the folder that a run of a study writes, run.json apart."""
        files = []
        for path in sorted(self.folder.glob("*")):
            if any(path.match(pattern) for pattern in RUN_FILES):
                files.append(path)
        return files

    def _note(self, **values: Any) -> None:
        """Write values to run.json."""
        self.about = self.about | values
        text = json.dumps(self.about, indent=1, sort_keys=True) + "\n"
        write_atomically(self.folder / RUN_FILE, text)

    @property
    def status(self) -> str:
        """How the training ended; empty while it has not."""
        return str(self.about.get("status", ""))

    def indicators(self, file: str) -> dict[int, dict[str, Any]]:
        """Content of a file by noise seed, of runs as long as the plan's; {} of a damaged one."""
        if file not in self._measured:
            self._measured[file] = self._read_indicators(file)
        return self._measured[file]

    def _read_indicators(self, file: str) -> dict[int, dict[str, Any]]:
        """`indicators` as they are on the disk."""
        path = self.folder / file
        if not path.is_file():
            return {}
        columns = () if file == TIMING else INDICATORS
        try:
            rows = read_table(path, columns, NOISE_KEY)
        except StudyError:
            self.remarks.append(f"'{path}' is damaged; made again")
            return {}
        # Rows of an earlier study in this folder may be of runs of another length.
        noise = self._noise(file)
        same_steps = rows.steps == noise.steps
        same_burn_in = rows.burn_in == noise.burn_in
        rows = rows[same_steps & same_burn_in]
        rows = rows.drop(columns=["steps", "burn_in"]).set_index("seed")
        rows = rows[~rows.index.duplicated()]
        measured: dict[int, dict[str, Any]] = rows.to_dict("index")
        return measured

    def _noise(self, file: str) -> Noise:
        """Noise on which a file's rows are measured; times are those of the evaluation."""
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
            is_there = (self.folder / file).is_file()
            return () if is_there else noise.seeds
        measured = self.indicators(file)
        return tuple(seed for seed in noise.seeds if seed not in measured)

    def items(
        self,
        shared_disk: bool,
    ) -> Iterator[tuple[str, TrainItem | MeasureItem]]:
        """Give out what can be done now, and count what is done.

        Args:
            shared_disk: whether the workers see this disk.

        Yields:
            The file of the result, `TRAINING` for the training, and the item.
        """
        run = self.run
        self.done = 0
        if run.training is not None:
            if not self.status:
                self._unseal()
                # A worker without this disk has its checkpoint in a folder of its own.
                folder = self.folder.absolute() if shared_disk else None
                yield TRAINING, TrainItem(run.conditions, run.training, folder)
                return
            self.done = run.training.samples
        for file, noise in run.noise.items():
            missing_seeds = self.missing(file)
            missing = noise._replace(seeds=missing_seeds)
            self.done += noise.samples - missing.samples
            if not missing_seeds:
                continue
            # Long enough to be worth its way to a worker, short enough to share the work evenly.
            n_samples = SAMPLES_OF_ITEM if run.conditions.all_ours else ITEM_SAMPLES
            seeds_of_an_item = max(1, n_samples // noise.length)
            evaluation = self._evaluation(file, missing)
            for part in evaluation.parts(seeds_of_an_item):
                yield file, part

    def _evaluation(self, file: str, noise: Noise) -> MeasureItem:
        """Evaluate the run's controller, or its θ, on some noise."""
        run = self.run
        parameters = ""
        if run.training is not None:
            parameters = (self.folder / PARAMETERS).read_text("utf-8")
        controller = run.source(parameters)
        item = MeasureItem(run.conditions, controller, noise, run.length)
        mark = run.marks.get(file)
        if mark is None:
            return item
        # In operation: the policy of the time on the plant of the time.
        from cosim.studies.operation import optimum_at, plant_at, theta_at  # noqa: PLC0415

        time_of_mark = mark * run.scenario.sampling_time
        plant = plant_at(run.scenario, time_of_mark)
        item = replace(item, plant=plant)
        if run.training is None:
            optimum = partial(optimum_at, sample=mark)
            return replace(item, controller=optimum)
        log = (self.folder / LOG).read_text("utf-8")
        return replace(item, theta=theta_at(log, mark))

    def store_training(self, result: Trained) -> None:
        """Store the result of the training; run.json is written last."""
        self._unseal()
        write_atomically(self.folder / LOG, result.log)
        write_atomically(self.folder / PARAMETERS, result.parameters)
        self.done = result.samples
        timing = {
            "wall_seconds": result.wall_seconds,
            "processor_seconds": dict(result.processor_seconds),
        }
        # Last, with the hashes: a training that is interrupted before this is done again.
        self._note(
            status=result.status,
            samples=result.samples,
            plant_samples=result.plant_samples,
            timing=timing,
            files={name: file_hash(self.folder / name) for name in TRAINED},
        )
        (self.folder / CHECKPOINT).unlink(missing_ok=True)

    def store_measurement(self, file: str, noise: Noise, result: Measured) -> None:
        """Store the result of an evaluation.

        Args:
            file: of the result.
            noise: what was measured on.
            result: indicators and times by noise seed, or one trajectory.
        """
        self._unseal()
        self.done += noise.samples
        if noise.whole:
            write_atomically(self.folder / file, result.trajectory)
            return
        self.indicators(file).update(result.indicators)
        self._unwritten.add(file)
        if file == EVALUATION:
            self.indicators(TIMING).update(result.timing)
            self._unwritten.add(TIMING)
        if time.monotonic() >= self._quiet_until:
            self.flush()

    def flush(self) -> None:
        """Write the tables that have changed."""
        import pandas as pd  # noqa: PLC0415

        clock = time.monotonic()
        while self._unwritten:
            file = self._unwritten.pop()
            noise = self._noise(file)
            rows = pd.DataFrame.from_dict(self._measured[file], "index")
            # In the order of the seeds, whichever worker was first.
            rows = rows.sort_index()
            if file != TIMING:
                rows = rows[list(INDICATORS)]
            rows.insert(0, "seed", rows.index)
            rows.insert(1, "steps", noise.steps)
            rows.insert(2, "burn_in", noise.burn_in)
            write_atomically(self.folder / file, frame_csv(rows))
        # A table is written whole each time: the pause keeps that a small share of the work.
        now = time.monotonic()
        self._quiet_until = now + PAUSE * (now - clock)

    def seal(self) -> None:
        """Write the hashes of a finished run's files to run.json."""
        is_trained = self.run.training is None or bool(self.status)
        is_evaluated = not any(self.missing(file) for file in self.run.noise)
        self.complete = is_trained and is_evaluated
        if not self.complete:
            return
        self.flush()
        hashes = {}
        for path in self._files():
            # Times differ from run to run: they are no result.
            if path.name != TIMING:
                hashes[path.name] = file_hash(path)
        if self.about.get("files") != hashes:
            self._note(files=hashes)

    def _unseal(self) -> None:
        """Remove the hashes before more is written, but those of the training's own files."""
        hashes = self.about.get("files", {})
        of_training = {name: digest for name, digest in hashes.items() if name in TRAINED}
        if of_training != hashes:
            self._note(files=of_training)


# The giving out of the work


class WorkKey(NamedTuple):
    """An item of work: its run, the file of its result, and its number among those of the run."""

    run: str
    file: str
    number: int


class Runner:
    """Do what the folders of runs lack.

    Args:
        runs: the runs of a study.
        out: its folder.
        report: called with the samples done, the state of the runs and a line, after each item.

    Raises:
        StudyError: two runs have one folder.
    """

    def __init__(self, runs: list[Run], out: Path, report: Progress):
        self._report = report
        by_folder: dict[str, Run] = {}
        for run in runs:
            # Upper and lower case are equal on some systems.
            folder = str(run.folder).lower()
            other = by_folder.setdefault(folder, run)
            if other is not run:
                raise StudyError(f"'{run}' and '{other}' would have one folder; rename one of them")
        self.stores: dict[str, RunStore] = {}
        for run in runs:
            self.stores[str(run)] = RunStore(out, run)
        self.failures: dict[str, Failure] = {}
        """The first failure of each run that failed."""
        # Runs of one case have the same remarks; a dictionary has each once, in their order.
        remarks: dict[str, None] = {}
        for store in self.stores.values():
            remarks.update(dict.fromkeys(store.remarks))
        self.remarks = list(remarks)
        """Changed or damaged work that is done again, in words."""

    def run(self, jobs: int, scheduler: str | None) -> None:
        """Do all that is not done; failed runs do not stop the others.

        Args:
            jobs: worker processes; 1 works in this process.
            scheduler: address of a Dask scheduler, used in place of `jobs`.

        Raises:
            EvaluationError: no worker can work.
        """
        try:
            # What a training leaves to evaluate is found once it is done.
            while items := self._items(shared_disk=scheduler is None):
                for key, result in done(items, jobs, scheduler, self._show):
                    if isinstance(result, Failure):
                        self._note_failure(key.run, result)
                    else:
                        self._store(key, items[key], result)
        finally:
            # After an interruption, too: what was measured is not measured again.
            for store in self.stores.values():
                store.flush()

    def _items(self, shared_disk: bool) -> dict[WorkKey, Item[Any]]:
        """Work that can be done now."""
        items: dict[WorkKey, Item[Any]] = {}
        for name, store in self.stores.items():
            if name in self.failures or store.complete:
                continue
            for number, (file, item) in enumerate(store.items(shared_disk)):
                key = WorkKey(name, file, number)
                items[key] = item
            # A run that lacks nothing is complete without an item.
            store.seal()
        self._tell("")
        return items

    def _note_failure(self, name: str, failure: Failure) -> None:
        """Store and report the first failure of a run."""
        if name in self.failures:
            return
        self.failures[name] = failure
        write_atomically(self.stores[name].folder / FAILURE, failure.traceback)
        self._tell(f"failed: {name}: {failure.message}")

    def _store(self, key: WorkKey, item: Item[Any], result: Any) -> None:
        """Store and report the result of an item."""
        store = self.stores[key.run]
        line = ""
        if isinstance(item, MeasureItem):
            store.store_measurement(key.file, item.noise, result)
            store.seal()
        else:
            store.store_training(result)
            if store.status != "finished":
                line = f"{key.run}: {store.status}"
        if store.complete:
            line = _end_of_run(key.run, store)
        self._tell(line)

    def _show(self, samples_at_work: int) -> None:
        """Report how far the items at work have come."""
        self._tell("", samples_at_work)

    def _tell(self, line: str, samples_at_work: int = 0) -> None:
        """Report the state of all runs, and a line on an event.

        Args:
            line: on the event; empty where there is none.
            samples_at_work: samples of the items that are not done.
        """
        stores = self.stores.values()
        n_complete = sum(store.complete for store in stores)
        state = f"{n_complete}/{len(stores)} runs"
        n_diverged = sum(store.status.startswith("diverged") for store in stores)
        if n_diverged:
            state += f", {n_diverged} diverged"
        if self.failures:
            state += f", {len(self.failures)} failed"
        samples_done = samples_at_work + sum(store.done for store in stores)
        self._report(samples_done, state, line)


def _end_of_run(name: str, store: RunStore) -> str:
    """A line on a run that is done."""
    indicators = store.indicators(EVALUATION)
    seeds = store.run.noise[EVALUATION].seeds
    costs = [indicators[seed]["J"] for seed in seeds]
    mean_cost = sum(costs) / len(costs)
    line = f"{name}: J {mean_cost:.6g}"
    # Without the reason of a divergence, which was reported as it happened.
    status, _, _ = store.status.partition(":")
    return f"{line}, {status}" if status else line
