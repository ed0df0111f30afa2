"""The training log: rows of named figures, sums between rows, CSV."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import inf, isnan

import numpy as np

from controllers.parameters import Parameters
from cosim.text_tables import csv_text
from learning.protocols import Update

COLUMNS = (
    "samples",
    "updates",
    "J",
    "td_error",
    "step",
    "smallest_eigenvalue",
    "corrected",
    "refused",
    "failures",
    "explored",
    "saturated",
    "weakly_active",
    "licq_failed",
    "plant_samples",
    "validated_J",
    "accepted",
    "greedy_J",
    "greedy_economic_cost",
    "greedy_mean_violation",
    "greedy_violating_share",
    "greedy_failures",
    "regret",
    "gap_closed",
)


class LogRow(Mapping[str, float]):
    """A line of the log: `figures` by column, NaN where not measured, and the `parameters` then.

    It reads as the mapping of its figures; the entries of θ get names in the CSV alone.
    """

    # A long run keeps many rows: small NumPy arrays, each alive among what comes and goes, would
    # hold a page of memory each.
    __slots__ = ("_blocks", "_figures", "_positions", "_theta")

    def __init__(self, figures: Mapping[str, float], parameters: Parameters) -> None:
        self._positions = _positions(tuple(figures))
        self._figures = np.fromiter(figures.values(), np.float64, len(figures)).tobytes()
        self._blocks, self._theta = parameters.blocks, parameters.theta.tobytes()

    @property
    def parameters(self) -> Parameters:
        """θ at the time of the row."""
        return Parameters(self._blocks, np.frombuffer(self._theta))

    def __getitem__(self, name: str) -> float:
        """A figure by its column."""
        return float(np.frombuffer(self._figures)[self._positions[name]])

    def __iter__(self) -> Iterator[str]:
        """The columns."""
        return iter(self._positions)

    def __len__(self) -> int:
        """Return the number of figures."""
        return len(self._positions)


@cache
def _positions(columns: tuple[str, ...]) -> dict[str, int]:
    """Where a column stands; the same dictionary for the same columns."""
    return {name: k for k, name in enumerate(columns)}


@dataclass
class Totals:
    """Sums since the last line of the log.

    `cost` over the `samples`; `updates`, and over these `squares` of the TD error, norms of the
    `step`, flags `corrected` and `refused`; `smallest_eigenvalue` is the least of all.
    """

    cost: float = 0.0
    samples: int = 0
    updates: int = 0
    squares: float = 0.0
    step: float = 0.0
    corrected: int = 0
    refused: int = 0
    smallest_eigenvalue: float = inf

    def add(self, update: Update) -> None:
        """Take an update."""
        self.updates += 1
        self.squares += update.td_error**2
        self.step += update.step
        self.corrected += update.corrected
        self.refused += update.refused
        self.smallest_eigenvalue = min(self.smallest_eigenvalue, update.smallest_eigenvalue)

    def means(self) -> dict[str, float]:
        """Means over the samples and their updates, NaN where there was none."""
        count = self.updates or float("nan")
        return {
            "J": self.cost / (self.samples or float("nan")),
            "updates": self.updates,
            "td_error": (self.squares / count) ** 0.5,
            "step": self.step / count,
            "corrected": self.corrected,
            "refused": self.refused,
        }


def to_csv(rows: Sequence[LogRow]) -> str:
    """The log as CSV with exact decimals: its figures, then a column `theta NAME` for each entry.

    What was not measured is left empty.
    """
    if not rows:
        return ""
    labels = [f"theta {label}" for label in rows[0].parameters.blocks.labels]
    return csv_text(
        [*rows[0], *labels],
        (map(_cell, [*row.values(), *row.parameters.theta.tolist()]) for row in rows),
    )


def _cell(value: float) -> str:
    return "" if isnan(value) else repr(int(value) if value == int(value) else value)
