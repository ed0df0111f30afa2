"""Runs of a study: what one is, its work, its folder, and the giving out of the work.

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
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from controllers.functions import COMPILED, INTERPRETED, LONG, switch
from cosim.core.errors import StudyError
from cosim.core.files import read_json, temporary_folder, write_atomically
from cosim.core.modules import UNKNOWN
from cosim.core.plugins import ControllerSource
from cosim.core.scenario import Scenario
from cosim.evaluation import EVALUATION, TIMING, Progress
from cosim.identity import changed, file_hash
from cosim.measurement import Factory, Measured, MeasureItem, Noise
from cosim.workers import Conditions, Failure, Item, done

if TYPE_CHECKING:
    import pandas as pd

    from learning.training_run import TrainingRun

RUNS, RUN, CHECKPOINT = "runs", "run.json", "checkpoint.npz"
TRAINED = LOG, PARAMETERS = "learning.csv", "parameters.toml"
GREEDY, FAILURE = "greedy.csv", "failure.txt"
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
Figures = dict[str, Any]


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


def safe(name: str) -> str:
    """A folder's name on any system."""
    return re.sub(r"[^\w.+=()\[\]-]", "_", name)


@dataclass(frozen=True)
class Training:
    """A training by its content.

    `arguments` are those of `learning`'s `make_run` but for the scenario; `start` is the text
    of the θ file at the start, None for a start with a name. In operation θ is judged at `marks`.
    """

    arguments: Mapping[str, Any]
    start: str | None = None
    marks: tuple[int, ...] = ()

    @property
    def samples(self) -> int:
        """Plant samples of the training."""
        return int(self.arguments["samples"])

    @property
    def kind(self) -> str:
        """The NMPC that carries θ."""
        return str(self.arguments["options"]["controller"])


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
    training: Training | None = None
    kept: Mapping[str, str] = field(default_factory=dict)
    marks: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (self.scenario.name, self.case):
            if not name.strip(". ") or "/" in name or "\\" in name:
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
        """Where its files are, relative to the study's folder."""
        parts = [safe(self.scenario.name), safe(self.case)]
        return Path(RUNS, *parts, *([] if self.seed is None else [str(self.seed)]))

    def __str__(self) -> str:
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"{self.case} on {self.scenario.name}{seed}"

    def source(self, parameters: str) -> ControllerSource | Factory:
        """The controller; of a training the NMPC of the θ that a TOML text holds."""
        if self.training is not None:
            return ControllerSource(PARAMETERS, parameters, self.training.kind)
        assert self.controller is not None
        return self.controller

    @property
    def samples(self) -> int:
        """Plant samples of the run; those of greedy evaluations while training apart."""
        trained = 0 if self.training is None else self.training.samples
        return trained + sum(noise.samples for noise in self.noise.values())

    @property
    def length(self) -> int:
        """Samples of the longest run among its evaluations."""
        return max(noise.length for noise in self.noise.values())


def functions_for(noise: Mapping[str, Noise]) -> str:
    """How controllers of these evaluations compute, `compiled` or `interpreted`.

    The two agree but for last digits, which are not to differ among the rows of one table.
    """
    long = max(noise.length for noise in noise.values()) >= LONG
    return COMPILED if long and switch() != "never" else INTERPRETED


# A worker's part of a run


@dataclass(frozen=True)
class Trained:
    """What a training gives: learning.csv and θ as texts, and what run.json says of it.

    `about` holds `status` (`finished` or `diverged: …`), `samples`, `plant_samples`, `timing` in s.
    """

    log: str
    parameters: str
    about: Mapping[str, Any]


@dataclass(frozen=True)
class TrainItem(Item[Trained]):
    """A training; its checkpoint lies in `folder` where the workers share this disk."""

    training: Training
    folder: Path | None

    def run(self) -> Trained:
        """Train, from the checkpoint if there is one."""
        from learning.training_run import make_run  # noqa: PLC0415

        arguments, begin = dict(self.training.arguments), time.perf_counter()
        options = dict(arguments.pop("options"))
        with temporary_folder("cosim-training-") as own:
            if self.training.start is not None:
                (own / "start.toml").write_text(self.training.start, "utf-8")
                options["start"] = str(own / "start.toml")
            run = make_run(scenario=self.conditions.scenario, **arguments, **options)
            trained = _in_operation if self.training.marks else _in_episodes
            log, parameters, about = trained(run, self.training.marks, self.folder or own)
        clock = about.pop("processor_seconds", {})
        timing = {"wall_seconds": time.perf_counter() - begin, "processor_seconds": clock}
        return Trained(log, parameters, about | {"timing": timing})


def _in_operation(
    run: TrainingRun, marks: Sequence[int], _: Path
) -> tuple[str, str, dict[str, Any]]:
    """Log, θ and facts of a training from one plant sample to the next."""
    from cosim.studies import operation  # noqa: PLC0415
    from learning.log import to_csv  # noqa: PLC0415

    rows, status, clock, taken = operation.live(run, marks)
    about = {"status": status, "samples": marks[-1], "plant_samples": taken}
    return to_csv(rows), rows[-1].parameters.to_toml(), about | {"processor_seconds": clock}


def _in_episodes(
    run: TrainingRun, _: Sequence[int], folder: Path
) -> tuple[str, str, dict[str, Any]]:
    """Log, θ and facts of a training as `cosim train` does it, its checkpoint in a folder."""
    from learning.log import to_csv  # noqa: PLC0415
    from learning.training import run_training  # noqa: PLC0415

    result = run_training(run, folder, resume=(folder / CHECKPOINT).is_file())
    samples = int(result.rows[-1]["samples"])
    about = {"status": result.status, "samples": samples, "plant_samples": result.plant_samples}
    # A study reports what the rule learned, be it worse than the start.
    return to_csv(result.rows), result.learned.to_toml(), about


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
        before = self.about.get("facts")
        unknown = [name for name, value in facts.items() if value == UNKNOWN]
        if before != facts or unknown:
            if before is not None and before != facts:
                names = ", ".join(changed(before, facts))
                self.remarks.append(f"{names} changed since these runs; they are done anew")
            elif before is not None:
                what = f"the code of {', '.join(unknown)} cannot be known"
                self.remarks.append(f"{what}: {run} is done anew")
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
            if file_hash(self.folder / name) == digest:
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

    def items(self, shared_disk: bool) -> Iterator[tuple[str, TrainItem | MeasureItem]]:
        """What can be done now by the file of its result: the training (""), or evaluations."""
        run, self.done = self.run, 0
        if run.training is not None:
            if not self.status:
                self._unseal()
                folder = self.folder.absolute() if shared_disk else None
                yield "", TrainItem(run.conditions, run.training, folder)
                return
            self.done = run.training.samples
        for file, noise in run.noise.items():
            missing = noise._replace(seeds=self.missing(file))
            self.done += noise.samples - missing.samples
            if missing.seeds:
                yield from ((file, part) for part in self._evaluation(file, missing).parts())

    def _evaluation(self, file: str, noise: Noise) -> MeasureItem:
        """Evaluate the run's controller, or its θ, on some noise."""
        run, mark = self.run, self.run.marks.get(file, 0)
        trained = run.training is not None
        controller = run.source((self.folder / PARAMETERS).read_text("utf-8") if trained else "")
        theta: tuple[float, ...] = ()
        plant = None
        if mark:
            from cosim.studies.operation import optimum_at, plant_at, theta_at  # noqa: PLC0415

            plant = plant_at(run.scenario, mark * run.scenario.sampling_time)
            if trained:
                theta = theta_at((self.folder / LOG).read_text("utf-8"), mark)
            else:
                controller = partial(optimum_at, sample=mark)
        return MeasureItem(run.conditions, controller, noise, run.length, theta, plant)

    def take(self, file: str, item: Item[Any], result: Trained | Measured) -> None:
        """Store the result of an item; of a training run.json is written last."""
        self._unseal()
        if isinstance(result, Trained):
            for name, text in zip(TRAINED, (result.log, result.parameters), strict=True):
                write_atomically(self.folder / name, text)
            self.done = result.about["samples"]
            files = {name: file_hash(self.folder / name) for name in TRAINED}
            self._note(**result.about, files=files)
            (self.folder / CHECKPOINT).unlink(missing_ok=True)
            return
        assert isinstance(item, MeasureItem)
        self.done += item.noise.samples
        if item.noise.whole:
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
            files = {path.name: file_hash(path) for path in self._files() if path.name != TIMING}
            if self.about.get("files") != files:
                self._note(files=files)

    def _unseal(self) -> None:
        """Remove the hashes before more is written, but those of the training's own files."""
        files = self.about.get("files", {})
        if files.keys() - TRAINED:
            self._note(files={name: files[name] for name in files.keys() & TRAINED})


# The giving out of the work


class Runner:
    """Does what the folders of runs lack; raises StudyError if two runs have one folder."""

    def __init__(self, runs: list[Run], out: Path, report: Progress):
        self._report = report
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
        try:
            while items := self._missing(shared_disk=scheduler is None):
                for key, result in done(items, jobs, scheduler):
                    self._take(*key[:2], items[key], result)
        finally:
            for store in self.stores.values():
                store.flush()

    def _missing(self, shared_disk: bool) -> dict[tuple[str, str, int], Item[Any]]:
        """Items by run, file and number."""
        items: dict[tuple[str, str, int], Item[Any]] = {}
        for name, store in self.stores.items():
            if name not in self.failures and not store.sealed:
                for number, (file, item) in enumerate(store.items(shared_disk)):
                    items[name, file, number] = item
                store.seal()
        self._tell("")
        return items

    def _take(
        self, name: str, file: str, item: Item[Any], result: Trained | Measured | Failure
    ) -> None:
        """Store and report the result of an item."""
        store, line = self.stores[name], ""
        if isinstance(result, Failure):
            if name in self.failures:
                return
            self.failures[name] = result
            write_atomically(store.folder / FAILURE, result.traceback)
            self._tell(f"failed: {name}: {result.message}")
            return
        store.take(file, item, result)
        if isinstance(result, Trained):
            line = "" if store.status == "finished" else f"{name}: {store.status}"
        else:
            store.seal()
        if store.sealed:
            found, seeds = store.indicators(EVALUATION), store.run.noise[EVALUATION].seeds
            status = store.status.partition(":")[0]
            line = f"{name}: J {sum(found[seed]['J'] for seed in seeds) / len(seeds):.6g}"
            line += f", {status}" if status else ""
        self._tell(line)

    def _tell(self, line: str) -> None:
        failed = f", {len(self.failures)} failed" if self.failures else ""
        sealed = sum(store.sealed for store in self.stores.values())
        runs = f"{sealed}/{len(self.stores)} runs{failed}"
        self._report(sum(store.done for store in self.stores.values()), runs, line)
