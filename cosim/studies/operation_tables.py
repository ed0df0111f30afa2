"""Tables of a scenario in operation, as texts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from cosim.core.protocols import Array
from cosim.core.result import TextTable
from cosim.core.statistics import (
    Interval,
    median_over_runs,
    paired_difference,
    shown,
    two_way,
)
from cosim.studies.operation import SHIFT
from cosim.studies.operation_result import OperationResult

HOUR = 3600.0
"""Seconds of an hour."""
DAY = 24 * HOUR
"""Seconds of a day."""
WEEK = 7 * DAY
"""Seconds of a week."""
EFFORT_COLUMNS = ["first_change", "violating", "dearest", "updates", "model_samples"]
"""Columns of operation.csv whose medians say what a run took."""


@dataclass(frozen=True)
class OperationLayout:
    """Layout of tables and figure of a scenario in operation.

    Attributes:
        sampling_time: of the plant, in s.
        columns: marks that tables show.
        drawn: cases that the figure shows; empty: all.
        changes: what changes in the plant, by the sample at which it does.
    """

    sampling_time: float
    columns: Sequence[int]
    drawn: Sequence[str] = ()
    changes: Mapping[int, Mapping[str, float]] = field(default_factory=dict)

    @property
    def times(self) -> list[str]:
        """The columns as times of operation."""
        return [duration(mark * self.sampling_time) for mark in self.columns]


def duration(seconds: float) -> str:
    """A time of operation in words of a calendar: `8 h`, `7 d`."""
    if seconds >= DAY:
        return f"{seconds / DAY:.3g} d"
    return f"{seconds / HOUR:.3g} h"


def operation_tables(
    result: OperationResult,
    scenario: str,
    layout: OperationLayout,
    against: Mapping[str, str | None],
    seconds: Mapping[str, float],
) -> Iterator[TextTable]:
    """Title, header and rows of a scenario's tables.

    Args:
        result: the regrets of all runs.
        scenario: its name.
        layout: what the tables show.
        against: the counterpart of each case, None where it has none.
        seconds: processor time in s of a case, up to the last column.
    """
    marks = layout.columns
    times = layout.times
    title = "Greedy regret in % of the final θ of a run that ends then, median [95 %] (worst)"
    header = ("case", "rank at the end", *times)
    yield f"{title}: `{scenario}`", header, _greedy_rows(result, marks)

    title = "Regret in % of the run so far, exploration included, median [95 %] (worst)"
    yield f"{title}: `{scenario}`", ("case", *times), _run_rows(result.runs, marks)

    # The effort is that of whole runs.
    end = result.runs[result.runs.samples == marks[-1]]
    title = f"What {times[-1]} of operation took on `{scenario}`, medians"
    effort_header = [
        "case",
        "runs",
        "first change, samples",
        "violating % since",
        "violations a week [95 %]",
        "dearest 100 samples %",
        "updates",
        "model samples",
    ]
    # Stored studies have no times.
    if seconds:
        effort_header.append("processor s")
    yield title, effort_header, _effort_rows(end, seconds, WEEK / layout.sampling_time)

    # Where θ never moves there is no shift to compare.
    rows = _shift_rows(end)
    if rows:
        title = f"Shifts of {SHIFT} samples dearer than θ as it starts, median (worst)"
        header = ("case", "runs", "shifts", "largest excess %")
        yield f"{title}: `{scenario}`", header, rows

    rows = _difference_rows(result, marks, against)
    if rows:
        title = "Greedy regret less the counterpart's, percentage points [95 %]"
        yield f"{title}: `{scenario}`", ("case", *times), rows


def _greedy_rows(result: OperationResult, marks: Sequence[int]) -> list[list[str]]:
    """Rank, and greedy regret with its interval over training seeds and noise, of each case."""
    ranks = result.ranks(marks[-1])
    rows = []
    for group, runs in result.runs.groupby("case", sort=False):
        case = str(group)
        rank = ranks.get(case)
        cells = [case, "" if rank is None else str(rank)]
        for mark in marks:
            runs_at_mark = runs[runs.samples == mark]
            cost = result.greedy[case][mark]
            # All runs of a case meet the same noise: seeds of both kinds are drawn anew.
            interval = two_way(cost.to_numpy(), result.optimum[mark])
            regret = runs_at_mark.regret.to_numpy()
            cells.append(_regret_cell(regret, interval))
        rows.append(cells)
    return rows


def _run_rows(runs: pd.DataFrame, marks: Sequence[int]) -> list[list[str]]:
    """Regret of each case's whole runs, with its interval over the runs, each on its own noise."""
    rows = []
    for case, case_runs in runs.groupby("case", sort=False):
        cells = [str(case)]
        for mark in marks:
            runs_at_mark = case_runs[case_runs.samples == mark]
            regret = runs_at_mark.life_regret.to_numpy()
            # A run's noise is its own: there is one kind of seed to draw.
            interval = median_over_runs(regret).interval
            cells.append(_regret_cell(regret, interval))
        rows.append(cells)
    return rows


def _regret_cell(regret: Array, interval: Interval) -> str:
    """Median of the regrets (R,) of the runs in %, its interval, and the worst."""
    if not len(regret):
        return ""
    median = _share_cell(float(np.median(regret)), interval)
    worst = _share_cell(float(regret.max()))
    return f"{median} ({worst})"


def _effort_rows(
    end: pd.DataFrame,
    seconds: Mapping[str, float],
    samples_per_week: float,
) -> list[list[str]]:
    """Effort of each case's median run.

    Args:
        end: rows of the runs at the last mark.
        seconds: processor time of each case; empty where none is known.
        samples_per_week: of the plant.
    """
    rows = []
    for group, runs in end.groupby("case", sort=False):
        case = str(group)
        median = runs[EFFORT_COLUMNS].median()
        cells = [
            case,
            str(len(runs)),
            _whole(median.first_change),
            f"{100 * median.violating:.2f}",
            _violations_cell(runs.violating, samples_per_week),
            f"{100 * median.dearest:.1f}",
            _whole(median.updates),
            _whole(median.model_samples),
        ]
        if seconds:
            cells.append(_whole(seconds.get(case, np.nan)))
        rows.append(cells)
    return rows


def _violations_cell(violating: pd.Series[float], samples_per_week: float) -> str:
    """Violating samples of a week of the median run, with the interval over the runs."""
    shares = violating.dropna().to_numpy()
    if not len(shares):
        return ""
    estimate = median_over_runs(shares * samples_per_week)
    return shown(*estimate, digits=3)


def _shift_rows(end: pd.DataFrame) -> list[list[str]]:
    """Shifts with a higher cost, of the cases that have moved θ for at least one."""
    rows = []
    moved = end[end.dearer.notna()]
    for case, runs in moved.groupby("case", sort=False):
        # In %, as all shares of J*.
        excess = 100 * runs.excess
        median_higher = _whole(runs.dearer.median())
        most_higher = _whole(runs.dearer.max())
        rows.append(
            [
                str(case),
                str(len(runs)),
                f"{median_higher} ({most_higher})",
                f"{excess.median():.2f} ({excess.max():.2f})",
            ]
        )
    return rows


def _difference_rows(
    result: OperationResult,
    marks: Sequence[int],
    against: Mapping[str, str | None],
) -> list[list[str]]:
    """Regret of a case less that of its counterpart, at each mark."""
    rows = []
    for case, other in against.items():
        if other is None or not result.optimum:
            continue
        # Cases that are not in operation have no costs.
        if not result.greedy.get(case) or not result.greedy.get(other):
            continue
        cells = [f"{case} − {other}"]
        for mark in marks:
            cost, other_cost = result.pairs(case, other, mark)
            # Without a training seed in common nothing is known.
            if not cost.size:
                cells.append("")
                continue
            median, interval, p = paired_difference(cost, other_cost, result.optimum[mark])
            cell = _share_cell(median, interval)
            # A single pair has no p.
            if not np.isnan(p):
                cell += f", p {p:.2f}"
            cells.append(cell)
        rows.append(cells)
    return rows


def _share_cell(share: float, interval: Interval = None) -> str:
    """A share in per cent, with its interval if there is one."""
    return shown(share, interval, scale=100.0, digits=3)


def _whole(value: float) -> str:
    """A number without decimals; empty where it is not known."""
    return "" if np.isnan(value) else f"{value:.0f}"
