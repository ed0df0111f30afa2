"""What a training's log shows: increments of θ by block, and means over a running window."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.errors import ResultsError

Array = NDArray[np.float64]
THETA = "theta "


def read_log(path: Path) -> dict[str, Array]:
    """Columns of learning.csv by name; an empty cell is NaN. Raises ResultsError."""
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    if not rows:
        raise ResultsError(f"the training log '{path}' is empty")
    return {
        name: np.array([float(row[name]) if row[name] else np.nan for row in rows])
        for name in rows[0]
    }


def increments(log: dict[str, Array], start: dict[str, float]) -> dict[str, Array]:
    """θ − θ₀ by block, (K, entries); `start` maps an entry's label, as in the log, to its θ₀."""
    blocks: dict[str, list[Array]] = {}
    for name, values in log.items():
        if name.startswith(THETA):
            label = name.removeprefix(THETA)
            blocks.setdefault(label.partition("[")[0], []).append(values - start[label])
    return {name: np.stack(columns, axis=1) for name, columns in blocks.items()}
