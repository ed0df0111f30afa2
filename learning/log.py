"""The log of a training: its columns, its rows, and its CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, isnan

from controllers.theta import Parameters
from cosim.core.result import csv_text

METRICS = ("economic_cost", "mean_violation", "violating_share", "J", "failures")
"""Evaluation of a greedy policy, means over its runs (failures: their sum)."""
LOG_COLUMNS = (
    "samples", "updates", "J", "td_error", "step", "smallest_eigenvalue", "corrected", "refused",
    "retreats",
    "failures", "explored", "saturated", "weakly_active", "licq_failed", "plant_samples",
    "greedy_J", "greedy_economic_cost", "greedy_mean_violation", "greedy_violating_share",
    "greedy_failures", "regret", "gap_closed",
)  # fmt: skip


class LogRow(dict[str, float]):
    """A line of the log: metrics by column, NaN where not measured, and the `parameters` then.

    Only the CSV names the entries of θ.
    """

    __slots__ = ("parameters",)

    def __init__(self, metrics: Mapping[str, float], parameters: Parameters) -> None:
        super().__init__(metrics)
        self.parameters = parameters


def to_csv(rows: Sequence[LogRow]) -> str:
    """The log as CSV: its metrics, empty where not measured, and a column `theta NAME` an entry."""
    if not rows:
        return ""
    columns = list(rows[0])
    for label in rows[0].parameters.blocks.labels:
        columns.append(f"theta {label}")
    lines = []
    for row in rows:
        # One number a cell, whole ones without a point.
        theta = row.parameters.theta.tolist()
        values = [*row.values(), *theta]
        lines.append([_cell(value) for value in values])
    return csv_text(columns, lines)


def _cell(value: float) -> str:
    if isnan(value):
        return ""
    # The cost of a diverged run is infinite.
    is_whole = isfinite(value) and value == int(value)
    if is_whole:
        return repr(int(value))
    return repr(value)
