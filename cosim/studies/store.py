"""A run: what it is made of, and what it has finished: a folder, readable and found again.

    OUT/runs/SCENARIO/CASE/SEED/   run.json  checkpoint.npz | learning.csv parameters.toml
                                   evaluation.csv  greedy.csv  online.csv
                                   trajectory-*.csv  timing.csv

Tables are written by the process that runs the study alone; a worker writes no more than the
checkpoint of the training that it runs, and its log and θ so far.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.errors import StudyError
from cosim.files import read_json, temporary_folder, write_atomically
from cosim.plugins import changed
from cosim.protocols import Controller
from cosim.scenario import Scenario
from cosim.studies.document import TrajectoryTable
from learning.training import TrainingRun, prepare

EVALUATION, GREEDY, ONLINE = "evaluation.csv", "greedy.csv", "online.csv"
RUNS = "runs"
RUN, CHECKPOINT = "run.json", "checkpoint.npz"
TRAINED = LOG, PARAMETERS = "learning.csv", "parameters.toml"
FAILURE, TIMING = "failure.txt", "timing.csv"
EVALUATED = "evaluated"
OURS = (CHECKPOINT, LOG, PARAMETERS, EVALUATION, GREEDY, FAILURE, ONLINE, TIMING)
PATTERNS = ("trajectory-*.csv", "greedy-*.csv")
INDICATORS = (
    "J", "economic_cost", "mean_violation", "violating_share", "input_effort", "failures",
)  # fmt: skip
KEY = ["seed", "steps", "burn_in"]
BLOCKS = ["seed", "steps", "block"]
WHERE = ["scenario", "case"]
KEYS = [*WHERE, "training_seed"]
STATE = [*KEYS, "status", "samples", "plant_samples"]
CURVE = ["samples", "J", "greedy_J", "td_error"]
TYPES: dict[str, Any] = {"scenario": str, "case": str, "training_seed": "Int64", "status": str}
"""Types of columns by name; all others are floats, NaN where a cell is empty."""
PAUSE = 20
"""Of the time that tables took to write, what passes at least until they are written again."""
Figures = dict[str, Any]
Measured = dict[int, tuple[Figures, Figures]]
"""Indicators, or the mean cost of each block as `J`, and what the clock said, by noise seed."""


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

    Indicators are kept; mean costs over `block` samples, where that is not 0; the run sample by
    sample, if it is `whole`. A policy of a run in operation is that of the sample `mark`.
    """

    seeds: tuple[int, ...]
    steps: int
    burn_in: int = 0
    block: int = 0
    whole: bool = False
    mark: int = 0

    @property
    def samples(self) -> int:
        """Plant samples on all seeds."""
        return len(self.seeds) * (self.burn_in + self.steps)


def greedy_file(mark: int) -> str:
    """File of a run's greedy evaluation of θ after `mark` samples of operation."""
    return f"greedy-{mark}.csv"


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
        """Refuse names that lead out of the study's folder."""
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
        """As messages name it."""
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"{self.case} on {self.scenario}{seed}"


@dataclass(frozen=True)
class Run:
    """One run: a controller, or a training and the θ that comes of it.

    `controller` is what `cosim.plugins.build_controller` takes, or a factory(scenario); None for a
    training. `noise` is what it is measured on, by the file that keeps what is found;
    `trajectories` are those that it takes part in. `marks` are the samples of operation at which
    θ, or the optimum, is judged.
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


def check_folders(runs: list[Run]) -> None:
    """Raise StudyError if two runs share a folder, upper and lower case being equal."""
    folders: dict[str, RunKey] = {}
    for run in runs:
        folder = str(run.key.folder).lower()
        if folder in folders:
            raise StudyError(
                f"'{run.key}' and '{folders[folder]}' would have one folder; rename one of them"
            )
        folders[folder] = run.key


def read_table(
    path: Path, columns: Sequence[str] = (), types: Mapping[str, Any] | None = None
) -> pd.DataFrame:
    """Columns of a CSV (default: all), typed by `types` and `TYPES`.

    Raises StudyError.
    """
    kinds = TYPES | dict(types or {})
    try:
        texts = pd.read_csv(path, dtype=str, na_filter=False)
        names = dict.fromkeys([*(columns or texts), *(types or ())])
        found = {name: _converted(texts[name], kinds.get(name, float)) for name in names}
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise StudyError(f"'{path}' is missing or damaged: {error}") from None
    return pd.DataFrame(found)


def _converted(texts: pd.Series[str], kind: Any) -> Any:
    if kind is float:
        return texts.replace("", "nan").astype(float)
    if kind == "Int64":
        return pd.array([int(text) if text else pd.NA for text in texts], dtype=kind)
    return texts.map(kind)  # whole numbers of 64 bits, too


def to_csv(frame: pd.DataFrame) -> str:
    """A frame as CSV; floats read back to the same bits, what is undefined is empty."""
    return str(frame.to_csv(index=False, lineterminator="\n"))


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


class RunStore:
    """The files of one run; `run.facts` say all that its results depend on.

    What is there of other facts, or is not as it was written, is deleted and named in `remarks`.
    Only files that a run of a study writes are deleted, and only beside a run.json. Raises
    StudyError where the folder holds other files than ours, or leads out of `out`.
    """

    def __init__(self, out: Path, run: Run) -> None:
        self.folder = out / run.key.folder
        self.remarks: list[str] = []
        """What was found changed or damaged, and is done anew."""
        self.run = run
        self._facts = json.loads(json.dumps(run.facts))
        self._known: dict[str, dict[int, Figures]] = {}
        self._unwritten: set[str] = set()
        self._quiet_until = 0.0
        if not self.folder.resolve().is_relative_to(out.resolve()):
            raise StudyError(f"'{self.folder}' leads out of '{out}'; choose another --out")
        (self.folder / FAILURE).unlink(missing_ok=True)
        self.about = self._found()
        if self.about.get("facts") != self._facts:
            self._begin()
        for file in run.noise:  # a damaged one is named before the work
            self.missing(file)

    def _found(self) -> dict[str, Any]:
        """run.json if it and its hashed files are intact, else {}."""
        path = self.folder / RUN
        if not path.is_file():
            if any(map(_ours, self.folder.glob("*"))):
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
        if (before := about["facts"]) != self._facts:
            names = ", ".join(changed(before, self._facts))
            self.remarks.append(f"{names} changed since these runs; they are done anew")
        return about

    def _begin(self) -> None:
        """Delete what the run has left, file by file, and mark the folder as its own."""
        for path in self.folder.glob("*"):
            if _ours(path):
                path.unlink()
        self.folder.mkdir(parents=True, exist_ok=True)
        self.about = {"facts": self._facts}
        self.note(status="")

    def note(self, **values: Any) -> None:
        """Write values to run.json."""
        self.about = self.about | values
        text = json.dumps(self.about, indent=1, sort_keys=True) + "\n"
        write_atomically(self.folder / RUN, text)

    @property
    def status(self) -> str:
        """How the training ended; empty while it has not."""
        return str(self.about.get("status", ""))

    @property
    def log(self) -> str:
        """The training's learning.csv, whose first row has θ at the start."""
        return (self.folder / LOG).read_text("utf-8")

    @property
    def parameters(self) -> str:
        """θ that the training ended with, as text."""
        return (self.folder / PARAMETERS).read_text("utf-8")

    def train(self, trained: Trained) -> None:
        """Store a finished training; run.json is written last."""
        write_atomically(self.folder / LOG, trained.log)
        write_atomically(self.folder / PARAMETERS, trained.parameters)
        self.note(
            status=trained.status,
            samples=trained.samples,
            plant_samples=trained.plant_samples,
            timing={"wall_seconds": trained.wall_seconds, "processor_seconds": trained.clock},
            files={name: _digest(self.folder / name) for name in TRAINED},
        )
        (self.folder / CHECKPOINT).unlink(missing_ok=True)

    def indicators(self, file: str) -> dict[int, Figures]:
        """What a file holds by noise seed of runs as long as the plan's, read once.

        Nothing of a damaged file, which is named.
        """
        if file not in self._known:
            try:
                self._known[file] = self._read(file)
            except StudyError:
                self.remarks.append(f"'{self.folder / file}' is damaged; made anew")
                self._known[file] = {}
        return self._known[file]

    def _read(self, file: str) -> dict[int, Figures]:
        noise = self.run.noise[EVALUATION if file == TIMING else file]
        key, columns = (BLOCKS, ["J"]) if noise.block else (KEY, INDICATORS)
        if not (self.folder / file).is_file():
            return {}
        wanted = () if file == TIMING else (*key, *columns)
        rows = read_table(self.folder / file, wanted, dict.fromkeys(key, int)).set_index("seed")
        rows = rows[(rows.steps == noise.steps) & (rows[key[2]] == (noise.block or noise.burn_in))]
        rows = rows.drop(columns=key[1:])
        rows = rows.groupby("seed").agg(list) if noise.block else rows[~rows.index.duplicated()]
        found: dict[int, Figures] = rows.to_dict("index")
        return found

    def measured(self, file: str) -> pd.DataFrame:
        """What a file of a finished run holds, a row for each noise seed, in the plan's order."""
        rows = pd.DataFrame.from_dict(self.indicators(file), "index")
        return rows.loc[list(self.run.noise[file].seeds)]

    def missing(self, file: str) -> tuple[int, ...]:
        """Noise seeds of which a file says nothing."""
        noise = self.run.noise[file]
        if noise.whole:
            return () if (self.folder / file).is_file() else noise.seeds
        return tuple(seed for seed in noise.seeds if seed not in self.indicators(file))

    def evaluate(self, file: str, found: Measured) -> None:
        """Append indicators to a file, and times to timing.csv."""
        parts = [(file, 0), *([(TIMING, 1)] if file == EVALUATION else [])]
        for name, part in parts:
            self.indicators(name).update({seed: pair[part] for seed, pair in found.items()})
            self._unwritten.add(name)
        if time.monotonic() >= self._quiet_until:
            self.flush()

    def flush(self) -> None:
        """Write the tables that wait for it."""
        # The rows of many seeds are written again and again: the pause keeps that a small share.
        begin = time.monotonic()
        while self._unwritten:
            self._write(self._unwritten.pop())
        self._quiet_until = time.monotonic() + PAUSE * (time.monotonic() - begin)

    def _write(self, file: str) -> None:
        rows = pd.DataFrame.from_dict(self._known[file], "index").sort_index()
        noise = self.run.noise[EVALUATION if file == TIMING else file]
        if noise.block:
            rows = rows.explode("J").astype(float)
        elif file != TIMING:
            rows = rows[list(INDICATORS)]
        key = BLOCKS if noise.block else KEY
        for place, value in enumerate((rows.index, noise.steps, noise.block or noise.burn_in)):
            rows.insert(place, key[place], value)
        write_atomically(self.folder / file, to_csv(rows))

    @property
    def finished(self) -> bool:
        """Whether all that the plan asks of the run is there."""
        trained = self.run.training is None or bool(self.status)
        return trained and not any(self.missing(file) for file in self.run.noise)

    def seal(self) -> None:
        """Note the hashes of a finished run's files, so that a torn or edited one is noticed."""
        self.flush()
        paths = filter(_ours, self.folder.glob("*"))
        files = {path.name: _digest(path) for path in sorted(paths) if path.name != TIMING}
        if self.about.get("files") != files:
            self.note(files=files)

    def unseal(self) -> None:
        """Forget the hashes before more is written, those of the training's own files excepted."""
        files = self.about.get("files", {})
        if files.keys() - TRAINED:
            self.note(files={name: files[name] for name in files.keys() & TRAINED})


def _ours(path: Path) -> bool:
    """Whether a file is one that a run of a study writes."""
    return path.name in OURS or any(map(path.match, PATTERNS))


def _digest(path: Path) -> str:
    """SHA-256 of a file, empty where it is not there."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def frames(stores: Sequence[RunStore]) -> list[pd.DataFrame]:
    """State, evaluation and curves of finished runs."""
    found = [_tables(store) for store in stores]
    result = []
    for i, header in enumerate((STATE, [*KEYS, "seed", "steps", *INDICATORS], [*KEYS, *CURVE])):
        parts = [tables[i][header] for tables in found if len(tables[i])]
        result.append(
            pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=header)
        )
    return result


def _tables(store: RunStore) -> list[pd.DataFrame]:
    """State, evaluation and curves of a finished run."""
    run, about = store.run, store.about
    key = {"scenario": run.key.scenario, "case": run.key.case, "training_seed": run.key.seed}
    state: dict[str, Any] = {"status": store.status or EVALUATED}
    state |= {name: int(about.get(name, 0)) for name in ("samples", "plant_samples")}
    evaluation = store.measured(EVALUATION).rename_axis("seed").reset_index()
    evaluation["steps"] = run.noise[EVALUATION].steps
    curve = pd.DataFrame(columns=CURVE)
    if run.training is not None:
        curve = read_table(store.folder / LOG).reindex(columns=CURVE)
    elif GREEDY in run.noise:
        greedy_J = float(store.measured(GREEDY).J.mean())
        curve = pd.DataFrame([{"greedy_J": greedy_J}], columns=CURVE)
    curve = curve.astype({"samples": "Int64"} | dict.fromkeys(CURVE[1:], float))
    tables = (pd.DataFrame([state]), evaluation, curve)
    return [table.assign(**key).astype({"training_seed": "Int64"}) for table in tables]


def timing(stores: Iterable[RunStore]) -> pd.DataFrame:
    """Seconds that each run's training took; in operation the processor's up to each mark, too."""
    rows = []
    for store in stores:
        clock = store.about.get("timing", {})
        seconds = {str(store.run.key): clock.get("wall_seconds", 0.0)}
        marks = clock.get("processor_seconds", {})
        seconds |= {f"{store.run.key}, sample {mark}": value for mark, value in marks.items()}
        rows += [{"run": name, "training_seconds": float(value)} for name, value in seconds.items()]
    return pd.DataFrame(rows, columns=["run", "training_seconds"])
