"""A study's tables as text: a few columns, significant digits, least regret first."""

from __future__ import annotations

import json
from typing import Any

from cosim.statistics import shown
from cosim.study.results import StudyResults
from cosim.study.summary import aggregate_rows, run_rows, summary_rows

Lines = list[list[str]]

HEADER = (
    "case", "plant samples", "finished", "regret %, median [95 %]", "worst", "IQM [95 %]",
    "J, median", "J, worst", "gap closed %", "economic cost", "violation", "violating %",
)  # fmt: skip
AGGREGATE_HEADER = ("case", "runs", "regret %, IQM [95 %]", "median", "worst")


def lines(results: StudyResults, scenario: str) -> Lines:
    """Rows of a scenario's table."""
    return [_line(row) for row in summary_rows(results, scenario)]


def _line(row: dict[str, Any]) -> list[str]:
    several = row["runs"] > 1
    return [
        row["case"],
        str(row["plant_samples"] or ""),
        f"{row['finished']}/{row['runs']}" if row["samples"] else "",
        percent(row, "regret_median"),
        percent(row, "regret_worst") if several else "",
        percent(row, "regret_iqm") if several else "",
        number(row["J_median"], 6),
        number(row["J_worst"], 6) if several else "",
        "" if row["gap_closed_median"] != row["gap_closed_median"]
        else shown(row["gap_closed_median"], None, 100.0, 4),
        number(row["economic_cost"], 6),
        f"{row['mean_violation']:.5f}",
        f"{100 * row['violating_share']:.2f}",
    ]  # fmt: skip


def aggregate_lines(results: StudyResults) -> Lines:
    """Rows of the table over all scenarios; [] where there is one."""
    return [
        [
            row["case"],
            str(row["runs"]),
            percent(row, "regret_iqm"),
            percent(row, "regret_median"),
            percent(row, "regret_worst"),
        ]
        for row in aggregate_rows(results)
    ]


def percent(row: dict[str, Any], name: str) -> str:
    """A share in per cent with its interval, where it has one; nothing where it is undefined."""
    value = float(row[name])
    low, high = float(row.get(f"{name}_low", "nan")), float(row.get(f"{name}_high", "nan"))
    if value != value:  # noqa: PLR0124 (NaN)
        return ""
    return shown(value, (low, high) if low == low else None, 100.0, 3)  # noqa: PLR0124


def number(value: float, digits: int) -> str:
    """A number with significant digits."""
    return shown(value, None, 1.0, digits)


def setting_lines(results: StudyResults) -> tuple[list[str], Lines]:
    """Header and rows of what each case is."""
    header = ["case", "algorithm or controller", "samples", "start", "NMPC", "settings"]
    rows = [
        [
            case.name,
            case.target,
            str(case.samples or ""),
            case.start,
            case.nmpc,
            ", ".join(f"{key} = {json.dumps(value)}" for key, value in case.settings.items()),
        ]
        for case in results.cases.values()
    ]
    return header, rows


def run_lines(results: StudyResults) -> tuple[list[str], Lines]:
    """Header and rows of every run."""
    header = ["case", "scenario", "seed", "status", "plant samples", "regret % [95 %]", "J"]
    rows = [
        [
            row["case"],
            row["scenario"],
            "" if row["training_seed"] is None else str(row["training_seed"]),
            row["status"],
            str(row["plant_samples"] or ""),
            percent(row, "regret"),
            number(row["J"], 6),
        ]
        for row in run_rows(results)
    ]
    return header, rows
