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


def running_mean(samples: Array, values: Array, weights: Array, window: int) -> Array:
    """Weighted mean of what lies within the `window` samples up to each row; NaN before that.

    `samples` (K,) is where a row ends, `values` (K,) its mean over `weights` (K,) updates; rows
    without updates count for nothing.
    """
    total = np.concatenate([[0.0], np.cumsum(np.where(weights > 0, values * weights, 0.0))])
    count = np.concatenate([[0.0], np.cumsum(weights)])
    ends = np.concatenate([[0.0], samples])
    first = np.searchsorted(ends, samples - window, side="left")
    last = np.arange(1, len(samples) + 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (total[last] - total[first]) / (count[last] - count[first])
    return np.where(samples >= window, mean, np.nan)
