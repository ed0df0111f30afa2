"""The paper's table with what it lacks: intervals over noise and training seeds, and J*."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.evaluation import Evaluation
from cosim.evaluation.statistics import Estimate, gain, gap_closed, mean, regret

Array = NDArray[np.float64]

FIGURES = ("J", "economic_cost", "mean_violation", "violating_share")
NAIVE, TUNED, OPTIMAL = "naive", "tuned", "optimal"
RELATIVE = {"gain_over_naive": NAIVE, "gain_over_tuned": TUNED}


@dataclass(frozen=True)
class Row:
    """A controller, or several of one learner, against the baselines.

    `estimates` by name: J, economic cost, mean violation, violating share, gain over naive and
    over tuned, regret, gap closed. Their t intervals are over the noise seeds for one controller,
    over the `training_seeds` for a learner; `worst_gap_closed` is that of its worst training seed.
    """

    controller: str
    training_seeds: int
    estimates: Mapping[str, Estimate]
    worst_gap_closed: float


def rows(evaluation: Evaluation, learners: Mapping[str, Sequence[str]]) -> list[Row]:
    """One row per controller; the controllers of a learner share one row.

    `learners` maps a learner's name to its controllers in the evaluation, one per training seed.
    """
    grouped = {name: group for group in learners.values() for name in group}
    single = [name for name in evaluation.controllers if name not in grouped]
    return [_single(evaluation, name) for name in single] + [
        _learner(evaluation, name, group) for name, group in learners.items()
    ]


def _single(evaluation: Evaluation, name: str) -> Row:
    estimates = {figure: mean(evaluation.column(name, figure)) for figure in FIGURES}
    cost = evaluation.column(name, "J")
    estimates |= _relative(evaluation, cost)
    gap = estimates.get("gap_closed")
    return Row(name, 0, estimates, gap.value if gap else float("nan"))


def _learner(evaluation: Evaluation, name: str, group: Sequence[str]) -> Row:
    estimates = {
        figure: mean(np.array([np.mean(evaluation.column(one, figure)) for one in group]))
        for figure in FIGURES
    }
    shares: dict[str, list[float]] = {}
    for one in group:
        for label, estimate in _relative(evaluation, evaluation.column(one, "J")).items():
            shares.setdefault(label, []).append(estimate.value)
    estimates |= {label: mean(np.array(values)) for label, values in shares.items()}
    return Row(name, len(group), estimates, min(shares.get("gap_closed", [float("nan")])))


def _relative(evaluation: Evaluation, cost: Array) -> dict[str, Estimate]:
    """Gains in J, regret and gap closed of J over the seeds, (S,)."""
    columns = {
        name: evaluation.column(name, "J")
        for name in (NAIVE, TUNED, OPTIMAL)
        if name in evaluation.controllers
    }
    found = {
        label: gain(cost, columns[name]) for label, name in RELATIVE.items() if name in columns
    }
    if OPTIMAL in columns:
        found["regret"] = regret(cost, columns[OPTIMAL])
    if NAIVE in columns and OPTIMAL in columns:
        found["gap_closed"] = gap_closed(cost, columns[NAIVE], columns[OPTIMAL])
    return found


class Table:
    """Flat rows, each led by the columns of what it belongs to, for CSV and report.

    An estimate takes three columns: its value, `_low` and `_high` of its t interval. All cells are
    text of eight digits; an undefined figure is an empty cell.
    """

    def __init__(self) -> None:
        self.records: list[dict[str, str]] = []

    def add(self, table: Sequence[Row], lead: Mapping[str, Any] | None = None) -> None:
        """Append rows, led by the columns `lead`."""
        for row in table:
            record = {name: _text(value) for name, value in (lead or {}).items()}
            record |= {"controller": row.controller, "training_seeds": str(row.training_seeds)}
            for name in (*FIGURES, "regret", *RELATIVE, "gap_closed"):
                record |= columns(name, row.estimates.get(name))
            record["worst_gap_closed"] = _text(row.worst_gap_closed)
            self.records.append(record)

    def to_csv(self) -> str:
        """The table as CSV."""
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.records)
        return text.getvalue()


def columns(name: str, estimate: Estimate | None) -> dict[str, str]:
    """An estimate's three cells by column name, empty where it is undefined."""
    low, high = (estimate.t if estimate else None) or (float("nan"), float("nan"))
    value = estimate.value if estimate else float("nan")
    return {name: _text(value), f"{name}_low": _text(low), f"{name}_high": _text(high)}


def against_converged(evaluation: Evaluation, pairs: Mapping[str, str]) -> Table:
    """RTI-NMPC against NMPC solved to convergence with the same θ, by the names of both."""
    table = Table()
    for rti, converged in pairs.items():
        record = {"rti": rti, "converged": converged}
        for name in FIGURES:
            one, other = evaluation.column(rti, name), evaluation.column(converged, name)
            record |= columns(f"{name}_rti", mean(one))
            record |= columns(f"{name}_difference", mean(other - one))
        table.records.append(record)
    return table


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else f"{value:.8g}"
