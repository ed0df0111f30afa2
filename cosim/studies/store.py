"""The folder of a run's results.

    OUT/runs/SCENARIO/CASE/SEED/   run.json  checkpoint.npz | learning.csv parameters.toml
                                   evaluation.csv  greedy.csv  greedy-*.csv  online-*.csv
                                   trajectory-*.csv  timing.csv

Only the process that runs the study writes tables; a worker writes the checkpoint of its training,
and its log and θ so far.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.errors import StudyError
from cosim.files import read_json, write_atomically
from cosim.plugins import changed
from cosim.studies.operation import LIFE
from cosim.studies.work import CHECKPOINT, Figures, Measured, Run, RunKey, Trained

EVALUATION, GREEDY = "evaluation.csv", "greedy.csv"
RUN = "run.json"
TRAINED = LOG, PARAMETERS = "learning.csv", "parameters.toml"
FAILURE, TIMING = "failure.txt", "timing.csv"
EVALUATED = "evaluated"
OURS = (CHECKPOINT, LOG, PARAMETERS, EVALUATION, GREEDY, FAILURE, TIMING)
PATTERNS = ("trajectory-*.csv", "greedy-*.csv", "online*.csv")
INDICATORS = (
    "J", "economic_cost", "mean_violation", "violating_share", "input_effort", "failures",
)  # fmt: skip
KEY = ["seed", "steps", "burn_in"]
WHERE = ["scenario", "case"]
KEYS = [*WHERE, "training_seed"]
STATE = [*KEYS, "status", "samples", "plant_samples"]
LIVES = [*KEYS, "samples", *LIFE]
CURVE = ["samples", "J", "greedy_J", "td_error"]
TYPES: dict[str, Any] = {"scenario": str, "case": str, "training_seed": "Int64", "status": str}
"""Types of columns by name; all others are floats, NaN where a cell is empty."""
PAUSE = 20
"""Least time between two writes of the tables, in multiples of the time that one takes."""


def greedy_file(mark: int) -> str:
    """File of a run's greedy evaluation of θ after `mark` samples of operation."""
    return f"greedy-{mark}.csv"


def online_file(mark: int) -> str:
    """File of the optimum's first `mark` samples on the noise of the training seeds."""
    return f"online-{mark}.csv"


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
    """A frame as CSV; floats read back to the same bits, NaN is empty."""
    return str(frame.to_csv(index=False, lineterminator="\n"))


class RunStore:
    """The files of one run; `run.facts` is all that its results depend on.

    Files of other facts, and those that were edited or damaged, are deleted and named in
    `remarks`: only files that a run of a study writes, and only beside a run.json. Raises
    StudyError where such files lie there without one, or the folder is outside `out`.
    """

    def __init__(self, out: Path, run: Run) -> None:
        self.folder = out / run.key.folder
        self.remarks: list[str] = []
        """What was changed or damaged and is done anew, in words."""
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
        """Delete the run's files and begin a new run.json."""
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
        """Content of a file by noise seed, of runs as long as the plan's; {} of a damaged one."""
        if file not in self._known:
            try:
                self._known[file] = self._read(file)
            except StudyError:
                self.remarks.append(f"'{self.folder / file}' is damaged; made anew")
                self._known[file] = {}
        return self._known[file]

    def _read(self, file: str) -> dict[int, Figures]:
        noise = self.run.noise[EVALUATION if file == TIMING else file]
        if not (self.folder / file).is_file():
            return {}
        wanted = () if file == TIMING else (*KEY, *INDICATORS)
        rows = read_table(self.folder / file, wanted, dict.fromkeys(KEY, int)).set_index("seed")
        rows = rows[(rows.steps == noise.steps) & (rows.burn_in == noise.burn_in)]
        rows = rows.drop(columns=KEY[1:])
        found: dict[int, Figures] = rows[~rows.index.duplicated()].to_dict("index")
        return found

    def measured(self, file: str) -> pd.DataFrame:
        """Content of a finished run's file, a row for each noise seed, in the plan's order."""
        rows = pd.DataFrame.from_dict(self.indicators(file), "index")
        return rows.loc[list(self.run.noise[file].seeds)]

    def missing(self, file: str) -> tuple[int, ...]:
        """Noise seeds that a file lacks."""
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
        """Write the tables that have changed."""
        # A table is written whole each time: the pause keeps that a small share of the work.
        begin = time.monotonic()
        while self._unwritten:
            self._write(self._unwritten.pop())
        self._quiet_until = time.monotonic() + PAUSE * (time.monotonic() - begin)

    def _write(self, file: str) -> None:
        rows = pd.DataFrame.from_dict(self._known[file], "index").sort_index()
        noise = self.run.noise[EVALUATION if file == TIMING else file]
        if file != TIMING:
            rows = rows[list(INDICATORS)]
        for place, value in enumerate((rows.index, noise.steps, noise.burn_in)):
            rows.insert(place, KEY[place], value)
        write_atomically(self.folder / file, to_csv(rows))

    @property
    def finished(self) -> bool:
        """Whether the run is complete."""
        trained = self.run.training is None or bool(self.status)
        return trained and not any(self.missing(file) for file in self.run.noise)

    def seal(self) -> None:
        """Write the hashes of a finished run's files to run.json."""
        self.flush()
        paths = filter(_ours, self.folder.glob("*"))
        files = {path.name: _digest(path) for path in sorted(paths) if path.name != TIMING}
        if self.about.get("files") != files:
            self.note(files=files)

    def unseal(self) -> None:
        """Remove the hashes before more is written, but those of the training's own files."""
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


def lives(stores: Sequence[RunStore]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows of the lives, by run and mark, and of the greedy evaluations, by noise seed, too.

    The optimum has a life on the noise of every training seed, of which J is known.
    """
    alive, greedy = [], []
    for store in (store for store in stores if store.run.marks):
        run, key = store.run, store.run.key
        names = {"scenario": key.scenario, "case": key.case}
        for mark in run.marks:
            rows = store.measured(greedy_file(mark)).rename_axis("seed").reset_index()
            greedy.append(rows.assign(**names, training_seed=key.seed, samples=mark))
        if run.training is not None:
            rows = read_table(store.folder / LOG, types={"samples": int})
            alive.append(rows.assign(**names, training_seed=key.seed))
        elif online_file(run.marks[0]) in run.noise:
            found = {mark: store.measured(online_file(mark))[["J"]] for mark in run.marks}
            rows = pd.concat(found, names=["samples", "training_seed"]).reset_index()
            alive.append(rows.sort_values(["training_seed", "samples"]).assign(**names))
    tables = []
    for parts, columns in ((alive, LIVES), (greedy, [*KEYS, "samples", "seed", "J"])):
        table = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)
        tables.append(table.reindex(columns=columns).astype({"training_seed": "Int64"}))
    return tables[0], tables[1]


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
