"""The tables of a study as CSV, written and read back: a row says what it is of, then figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.errors import StudyError
from cosim.study.records import CURVE, RunResult
from cosim.study.store import INDICATORS
from cosim.text_tables import cell, csv_text, read_records

Array = NDArray[np.float64]
Row = Mapping[str, Any]

EVALUATION, CURVES, RUNS, TIMING = "evaluation.csv", "curves.csv", "runs.csv", "timing.csv"
KEYS = ("scenario", "case", "training_seed")
RUN = (*KEYS, "status", "samples", "plant_samples")


def to_csv(columns: Sequence[str], rows: Iterable[Row]) -> str:
    """Rows as CSV; floats read back to the same bits, what is undefined is empty."""
    return csv_text(columns, ([cell(row.get(name)) for name in columns] for row in rows))


def evaluation_csv(runs: Sequence[RunResult]) -> str:
    """A row for each run and noise seed."""
    rows = (
        _key(run)
        | {"seed": seed, "steps": run.steps}
        | {name: float(run.indicators[name][i]) for name in INDICATORS}
        for run in runs
        for i, seed in enumerate(run.seeds)
    )
    return to_csv((*KEYS, "seed", "steps", *INDICATORS), rows)


def curves_csv(runs: Sequence[RunResult]) -> str:
    """A row for each row of a training's log; one, without samples, for each controller."""
    rows: list[dict[str, Any]] = []
    for run in runs:
        if run.seed is None and not np.isnan(run.greedy_J):
            rows.append(_key(run) | {"greedy_J": run.greedy_J})
        for i in range(len(run.curve["samples"]) if run.curve else 0):
            values = {name: float(run.curve[name][i]) for name in CURVE}
            rows.append(_key(run) | values | {"samples": int(values["samples"])})
    return to_csv((*KEYS, *CURVE), rows)


def _key(run: RunResult) -> dict[str, Any]:
    return {"scenario": run.scenario, "case": run.case, "training_seed": run.seed}


def read_runs(folder: Path) -> list[RunResult]:
    """The runs that a folder's tables hold, in their order; raises StudyError."""
    try:
        return _read_runs(folder)
    except (KeyError, TypeError, ValueError) as error:
        raise StudyError(f"the tables in '{folder}' are damaged: {error!r}") from None


def _read_runs(folder: Path) -> list[RunResult]:
    evaluations = _grouped(read_records(folder / EVALUATION, StudyError))
    curves = _grouped(read_records(folder / CURVES, StudyError))
    found = []
    for row in read_records(folder / RUNS, StudyError):
        key = tuple(row[name] for name in KEYS)
        noise, log = evaluations[key], curves.get(key, [])
        trained = bool(row["training_seed"])
        found.append(
            RunResult(
                scenario=row["scenario"],
                case=row["case"],
                seed=int(row["training_seed"]) if trained else None,
                status=row["status"],
                samples=int(row["samples"]),
                plant_samples=int(row["plant_samples"]),
                seeds=tuple(int(one["seed"]) for one in noise),
                steps=int(noise[0]["steps"]),
                indicators={
                    name: np.array([_number(one[name]) for one in noise]) for name in INDICATORS
                },
                curve={name: np.array([_number(one[name]) for one in log]) for name in CURVE}
                if trained
                else {},
                greedy_J=float("nan") if trained or not log else _number(log[0]["greedy_J"]),
            )
        )
    return found


def _grouped(rows: list[dict[str, str]]) -> dict[tuple[str, ...], list[dict[str, str]]]:
    found: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in KEYS), []).append(row)
    return found


def _number(text: str) -> float:
    return float(text) if text else float("nan")


def read_numbers(path: Path) -> dict[str, Array]:
    """Columns by name of a table of numbers, a training's log say; an empty cell is NaN.

    Raises StudyError.
    """
    rows = read_records(path, StudyError)
    if not rows:
        raise StudyError(f"'{path}' has no rows")
    try:
        return {name: np.array([_number(row[name]) for row in rows]) for name in rows[0]}
    except (TypeError, ValueError) as error:
        raise StudyError(f"'{path}' is damaged: {error}") from None
