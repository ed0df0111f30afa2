"""What a study has finished, on disk: a folder for each run, readable and found again.

    OUT/runs/SCENARIO/CASE/SEED/   run.json  checkpoint.npz | learning.csv parameters.toml
                                   evaluation.csv  greedy.csv  online.csv

Only the process that runs the study writes, so workers need no shared disk.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.errors import StudyError
from cosim.files import read_json, write_atomically
from cosim.study.document import TrajectoryTable
from cosim.study.protocols import Progress
from cosim.text_tables import cell, csv_pieces, csv_text, read_records

RUNS = "runs"
RUN, CHECKPOINT = "run.json", "checkpoint.npz"
LOG, PARAMETERS = "learning.csv", "parameters.toml"
EVALUATION, GREEDY, FAILURE = "evaluation.csv", "greedy.csv", "failure.txt"
ONLINE = "online.csv"
INDICATORS = (
    "J",
    "economic_cost",
    "mean_violation",
    "violating_share",
    "input_effort",
    "failures",
)
Indicators = dict[int, dict[str, float]]
"""Indicators of a controller by noise seed."""


@dataclass(frozen=True)
class RunKey:
    """A run of a study: scenario, case, and training seed (None for a controller)."""

    scenario: str
    case: str
    seed: int | None

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
class Online:
    """Trainings that a controller runs beside: `seeds`, the longest one's `steps`, the `block`."""

    seeds: tuple[int, ...]
    steps: int
    block: int


def safe(name: str) -> str:
    """A folder's name on any system."""
    return re.sub(r"[^\w.+=()\[\]-]", "_", name)


class RunStore:
    """The files of one run; `facts` say all that its results depend on.

    What is there of other facts is dropped, never mixed in.
    """

    def __init__(self, out: Path, key: RunKey, facts: Mapping[str, Any]) -> None:
        self.folder = out / key.folder
        self._facts = json.loads(json.dumps(facts))
        self._known: dict[tuple[str, int], Indicators] = {}
        (self.folder / FAILURE).unlink(missing_ok=True)
        self._about = self._document()
        if self._about.get("facts") != self._facts:
            shutil.rmtree(self.folder, ignore_errors=True)
            self.folder.mkdir(parents=True, exist_ok=True)
            self._about = {"facts": self._facts}
            self._note(status="")

    def _document(self) -> dict[str, Any]:
        path = self.folder / RUN
        if not path.is_file():
            return {}
        try:
            return read_json(path, f"'{path}'", StudyError)
        except StudyError as error:
            raise StudyError(f"{error}; delete its folder to run it again") from None

    def progress(self) -> Progress:
        """Where the run's training stands."""
        document = self._about
        if status := document.get("status", ""):
            return Progress(
                int(document["samples"]),
                status,
                log=self._read(LOG),
                parameters=self._read(PARAMETERS),
                plant_samples=int(document["plant_samples"]),
                wall_seconds=float(document["timing"]["wall_seconds"]),
            )
        path = self.folder / CHECKPOINT
        if not path.is_file():
            return Progress(0)
        return Progress(
            int(document.get("samples", 0)),
            checkpoint=path.read_bytes(),
            wall_seconds=float(document.get("timing", {}).get("wall_seconds", 0.0)),
        )

    def advance(self, progress: Progress) -> None:
        """Store how far a training has come; run.json last, so that what it says is there."""
        if progress.ended:
            self._write(LOG, progress.log)
            self._write(PARAMETERS, progress.parameters)
        else:
            self._write(CHECKPOINT, progress.checkpoint)
        self._note(
            status=progress.status,
            samples=progress.samples,
            plant_samples=progress.plant_samples,
            timing={
                "wall_seconds": progress.wall_seconds,
                "functions": self._with(progress.functions),
            },
        )
        if progress.ended:
            (self.folder / CHECKPOINT).unlink(missing_ok=True)

    @property
    def functions(self) -> list[str]:
        """How the functions of the run's units were computed: `compiled`, `interpreted`, both."""
        return list(self._about.get("timing", {}).get("functions", []))

    def used(self, functions: str | None) -> None:
        """Note how a unit's functions were computed, None where that is not known."""
        if functions is not None and functions not in self.functions:
            timing = self._about.get("timing", {}) | {"functions": self._with(functions)}
            self._note(timing=timing)

    def _with(self, functions: str | None) -> list[str]:
        return sorted({*self.functions, *([] if functions is None else [functions])})

    def _note(self, **changes: Any) -> None:
        self._about = self._about | changes
        self._write(RUN, json.dumps(self._about, indent=1, sort_keys=True) + "\n")

    def indicators(self, file: str, steps: int) -> Indicators:
        """Indicators by noise seed that a file holds of runs of `steps` samples, read once."""
        if (file, steps) not in self._known:
            self._known[file, steps] = self._read_indicators(file, steps)
        return self._known[file, steps]

    def _read_indicators(self, file: str, steps: int) -> Indicators:
        path = self.folder / file
        if not path.is_file():
            return {}
        try:
            return {
                int(row["seed"]): {name: float(row[name] or "nan") for name in INDICATORS}
                for row in read_records(path, StudyError)
                if int(row["steps"]) == steps
            }
        except (StudyError, KeyError, ValueError):
            raise StudyError(f"'{path}' is damaged; delete it to evaluate again") from None

    def missing(self, file: str, seeds: Sequence[int], steps: int) -> list[int]:
        """Noise seeds without indicators in a file."""
        known = self.indicators(file, steps)
        return [seed for seed in seeds if seed not in known]

    def evaluate(self, file: str, steps: int, fresh: Indicators) -> None:
        """Add indicators to a file."""
        known = self.indicators(file, steps)
        known.update(fresh)
        rows = (
            [str(seed), str(steps), *(cell(values[name]) for name in INDICATORS)]
            for seed, values in sorted(known.items())
        )
        write_atomically(self.folder / file, csv_pieces(("seed", "steps", *INDICATORS), rows))

    def online(self, online: Online) -> dict[int, list[float]]:
        """Mean costs of blocks by training seed."""
        path = self.folder / ONLINE
        found: dict[int, list[float]] = {}
        if not path.is_file():
            return found
        try:
            for row in read_records(path, StudyError):
                if (int(row["steps"]), int(row["block"])) == (online.steps, online.block):
                    found.setdefault(int(row["seed"]), []).append(float(row["J"]))
        except (StudyError, KeyError, ValueError):
            raise StudyError(f"'{path}' is damaged; delete it to run again") from None
        return found

    def missing_online(self, online: Online | None) -> list[int]:
        """Seeds of trainings that the controller has not run beside yet."""
        if online is None:
            return []
        known = self.online(online)
        return [seed for seed in online.seeds if seed not in known]

    def accompany(self, online: Online, seed: int, costs: Sequence[float]) -> None:
        """Add the mean costs of a run's blocks."""
        known = self.online(online) | {seed: list(costs)}
        rows = (
            [str(one), str(online.steps), str(online.block), cell(cost)]
            for one, costs in sorted(known.items())
            for cost in costs
        )
        self._write(ONLINE, csv_text(("seed", "steps", "block", "J"), rows))

    def _trace(self, trace: TrajectoryTable) -> Path:
        return self.folder / f"trajectory-{trace.name}-{trace.seed}-{trace.steps}.csv"

    def trajectory(self, trace: TrajectoryTable) -> Path | None:
        """File of a trajectory, None if there is none yet."""
        path = self._trace(trace)
        return path if path.is_file() else None

    def trace(self, trace: TrajectoryTable, trajectory: str) -> None:
        """Store a trajectory."""
        write_atomically(self._trace(trace), trajectory)

    def fail(self, trace: str) -> None:
        """Keep the traceback of what failed."""
        self._write(FAILURE, trace)

    def _read(self, name: str) -> str:
        try:
            return (self.folder / name).read_text("utf-8")
        except (OSError, UnicodeDecodeError):
            raise StudyError(
                f"'{self.folder / name}' is damaged; delete the folder to run it again"
            ) from None

    def _write(self, name: str, content: str | bytes) -> None:
        write_atomically(self.folder / name, content)
