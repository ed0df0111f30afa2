"""The training log: rows of named figures, sums between rows, CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isnan

import numpy as np

from controllers.theta import Parameters
from cosim.text_tables import csv_text
from learning.algorithm import Update

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
    "greedy_J",
    "greedy_economic_cost",
    "greedy_mean_violation",
    "greedy_violating_share",
    "greedy_failures",
    "regret",
    "gap_closed",
)


class LogRow(dict[str, float]):
    """A line of the log: figures by column, NaN where not measured, and the `parameters` then.

    The entries of θ have names in the CSV alone.
    """

    __slots__ = ("parameters",)

    def __init__(self, figures: Mapping[str, float], parameters: Parameters) -> None:
        super().__init__(figures)
        self.parameters = parameters


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

    def add(self, cost: float, update: Update | None) -> None:
        """Take a sample's cost and its update, if there was one."""
        self.cost += cost
        self.samples += 1
        if update is None:
            return
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


def late_movement(start: Parameters, rows: Sequence[LogRow]) -> float:
    """‖θ_K − θ_0.8K‖/‖θ_K − θ_0‖ in scaled entries: the criterion of convergence, below 0.05.

    θ_0.8K is that of the last row within the first four fifths of the samples. NaN where θ never
    moved or the log has no such row.
    """
    early = [row for row in rows if row["samples"] <= 0.8 * rows[-1]["samples"]]
    if not early:
        return float("nan")
    last, scale = rows[-1].parameters.theta, start.blocks.scale
    way = float(np.linalg.norm((last - start.theta) / scale))
    moved = float(np.linalg.norm((last - early[-1].parameters.theta) / scale))
    return moved / way if way > 0 else float("nan")
