"""Tables of a study as texts: of a scenario, of all scenarios, of the paper, of runs and cases."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from cosim.core.errors import StudyError
from cosim.core.result import TextTable
from cosim.core.statistics import shown
from cosim.core.validation import instead
from cosim.studies.case_runs import columns_of
from cosim.studies.measurements import StudyMeasurements
from cosim.studies.operation_tables import operation_tables
from cosim.studies.paper_claim import paper_table

TitledRows = tuple[Sequence[str], list[list[str]]]
"""Header of a table and its rows of texts."""

REPORT_COLUMNS = {
    "case": "case",
    "rank": "rank",
    "samples": "plant samples",
    "finished": "finished",
    "regret": "regret %, median [95 %]",
    "worst": "worst [95 %]",
    "iqm": "IQM [95 %]",
    "J": "J, median",
    "J-worst": "J, worst",
    "gap": "gap closed %",
    "economic": "economic cost",
    "violation": "violation",
    "violating": "violating %",
    "week": "violations a week [95 %]",
    "against": "against",
    "difference": "difference % [95 %]",
    "p": "p",
}
"""Titles of the columns of a scenario's table, by the names that options take."""
SHORT_COLUMNS = ("case", "rank", "regret", "worst", "violating", "finished")
"""Columns that a table has where nobody names others."""
DIFFERENCE_COLUMNS = ("against", "difference", "p")
"""Columns of the paired difference from a case's counterpart."""


def scenario_table(
    study: StudyMeasurements,
    scenario: str,
    columns: Sequence[str] | None = None,
) -> TitledRows:
    """The table of a scenario, lowest J first.

    Args:
        study: the measurements.
        scenario: its name.
        columns: keys of `REPORT_COLUMNS`; by default all of which something is known.

    Raises:
        StudyError: there is no such column.
    """
    if columns is None:
        columns = _known_columns(study, scenario)
    for name in columns:
        if name not in REPORT_COLUMNS:
            raise StudyError(f"a table has no column '{name}'{instead(name, REPORT_COLUMNS)}")
    titles = [REPORT_COLUMNS[name] for name in columns]
    summaries = study.summary[study.summary.scenario == scenario]
    rows = []
    for summary in summaries.to_dict("records"):
        intervals = _printed_intervals(study, summary)
        cells = _summary_cells(summary | intervals)
        rows.append([cells[name] for name in columns])
    return titles, rows


def _known_columns(study: StudyMeasurements, scenario: str) -> list[str]:
    """Columns of a scenario's table of which the study knows something."""
    columns = list(REPORT_COLUMNS)
    has_counterparts = any(case.get("against") for case in study.cases.values())
    if not has_counterparts:
        for name in DIFFERENCE_COLUMNS:
            columns.remove(name)
    # Without a sampling time nobody knows how many samples a week has.
    if study.sampling_time(scenario) is None:
        columns.remove("week")
    return columns


def _printed_intervals(study: StudyMeasurements, summary: Mapping[str, Any]) -> dict[str, float]:
    """Intervals of a printed row, beside its columns of the summary."""
    case = summary["case"]
    scenario = summary["scenario"]
    # Of one training the interval is over the noise alone.
    trained_once = study.case_runs[scenario, case].is_trained_once
    kind = "regret_median" if trained_once else "regret_wide"
    runs = study.runs_of(case, scenario)
    worst = runs.iloc[int(np.argmax(runs.J))]
    violations = study.violations_per_week(case, scenario)
    return {
        "regret_shown_low": summary[f"{kind}_low"],
        "regret_shown_high": summary[f"{kind}_high"],
        "regret_worst_low": worst.regret_low,
        "regret_worst_high": worst.regret_high,
        **columns_of("violations_week", violations),
    }


def _summary_cells(row: Mapping[str, Any]) -> dict[str, str]:
    """Texts of a row of the summary, by the keys of `REPORT_COLUMNS`."""
    cells = {
        "case": row["case"],
        "rank": "" if pd.isna(row["rank"]) else str(row["rank"]),
        # A controller is not trained, and takes no samples before it is evaluated.
        "samples": str(row["plant_samples"] or ""),
        "finished": f"{row['finished']}/{row['runs']}" if row["samples"] else "",
        "regret": _percent(row, "regret_median", interval="regret_shown"),
        "worst": _percent(row, "regret_worst"),
        "iqm": _percent(row, "regret_iqm"),
        "J": shown_number(row["J_median"]),
        "J-worst": shown_number(row["J_worst"]),
        "gap": _percent(row, "gap_closed_median", digits=4),
        "economic": shown_number(row["economic_cost"]),
        "violation": f"{row['mean_violation']:.5f}",
        "violating": f"{100 * row['violating_share']:.2f}",
        "week": _estimate(row, "violations_week"),
        "against": row["against"] if isinstance(row["against"], str) else "",
        "difference": _percent(row, "difference"),
        "p": "" if np.isnan(row["difference_p"]) else f"{row['difference_p']:.3f}",
    }
    # A single run is the worst and the mean of itself.
    if row["runs"] == 1:
        for name in ("worst", "iqm", "J-worst"):
            cells[name] = ""
    return cells


def aggregate_table(study: StudyMeasurements) -> TitledRows:
    """Regrets over the runs of all scenarios."""
    header = ("case", "runs", "regret %, IQM [95 %]", "median", "worst")
    rows = []
    for row in study.aggregate.to_dict("records"):
        rows.append(
            [
                row["case"],
                str(row["runs"]),
                _percent(row, "regret_iqm"),
                _percent(row, "regret_median"),
                _percent(row, "regret_worst"),
            ]
        )
    return header, rows


def cases_table(study: StudyMeasurements) -> TitledRows:
    """Description of each case."""
    header = ("case", "algorithm or controller", "samples", "start", "NMPC", "settings")
    rows = []
    for case in study.cases.values():
        settings = []
        for name, value in case["settings"].items():
            # As a study file writes it, but for the words of TOML.
            settings.append(f"{name} = {json.dumps(value)}")
        rows.append(
            [
                case["name"],
                case["target"],
                str(case["samples"] or ""),
                case["start"],
                case["nmpc"],
                ", ".join(settings),
            ]
        )
    return header, rows


def runs_table(study: StudyMeasurements) -> TitledRows:
    """Every run by itself."""
    header = ("case", "scenario", "seed", "status", "plant samples", "regret % [95 %]", "J")
    rows = []
    for row in study.runs.to_dict("records"):
        seed = row["training_seed"]
        rows.append(
            [
                row["case"],
                row["scenario"],
                "" if pd.isna(seed) else str(seed),
                row["status"],
                str(row["plant_samples"] or ""),
                _percent(row, "regret"),
                shown_number(row["J"]),
            ]
        )
    return header, rows


def further_tables(study: StudyMeasurements) -> Iterator[TextTable]:
    """Title, header and rows of the tables that the study asks for beside its summary."""
    against = {name: case.get("against") for name, case in study.cases.items()}
    for scenario in study.scenarios_in_operation:
        yield from operation_tables(
            study.operation_result(scenario),
            scenario,
            study.operation_layout(scenario),
            against,
            study.processor_seconds(scenario),
        )
    if "paper" in study.about["tables"]:
        yield paper_table(study)


def _percent(row: Mapping[str, Any], name: str, *, interval: str = "", digits: int = 3) -> str:
    """A share in per cent with its interval, if any; empty if undefined.

    Args:
        row: of a table.
        name: column of the share.
        interval: column of the interval, without `_low` and `_high`; default: the share's.
        digits: significant ones.
    """
    return _estimate(row, name, interval=interval, scale=100.0, digits=digits)


def _estimate(
    row: Mapping[str, Any],
    name: str,
    *,
    interval: str = "",
    scale: float = 1.0,
    digits: int = 3,
) -> str:
    """A number with its interval, if any; empty if undefined; arguments as of `_percent`."""
    value = float(row[name])
    if np.isnan(value):
        return ""
    columns = interval or name
    low = float(row.get(f"{columns}_low", np.nan))
    high = float(row.get(f"{columns}_high", np.nan))
    # In a table, a missing interval has two empty cells.
    ends = None if np.isnan(low) else (low, high)
    return shown(value, ends, scale, digits)


def shown_number(value: float) -> str:
    """A cost with six digits."""
    return shown(float(value), digits=6)
