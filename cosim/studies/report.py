"""A study's report: one HTML page that needs nothing else, and the same tables as Markdown."""

from __future__ import annotations

import base64
import json
import re
import shlex
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader, select_autoescape

from cosim.core.result import markdown_table
from cosim.core.statistics import shown

PAGE = "report.html"
MARKDOWN = "report.md"
FOLDER = "figures"
"""Folder of the figures."""

Text = Callable[[Mapping[str, Any]], str]
"""Text of a table's cell, from the row."""

REPORT_COLUMNS: dict[str, tuple[str, Text]] = {
    "case": ("case", lambda row: row["case"]),
    "rank": ("rank", lambda row: "" if pd.isna(row["rank"]) else str(row["rank"])),
    "samples": ("plant samples", lambda row: str(row["plant_samples"] or "")),
    "finished": (
        "finished",
        lambda row: f"{row['finished']}/{row['runs']}" if row["samples"] else "",
    ),
    "regret": (
        "regret %, median [95 %]",
        lambda row: _percent_cell(row, "regret_median", "regret_shown"),
    ),
    "worst": (
        "worst [95 %]",
        lambda row: _percent_cell(row, "regret_worst") if row["runs"] > 1 else "",
    ),
    "iqm": ("IQM [95 %]", lambda row: _percent_cell(row, "regret_iqm") if row["runs"] > 1 else ""),
    "J": ("J, median", lambda row: _number_text(row["J_median"])),
    "J-worst": ("J, worst", lambda row: _number_text(row["J_worst"]) if row["runs"] > 1 else ""),
    "gap": ("gap closed %", lambda row: _percent_cell(row, "gap_closed_median", digits=4)),
    "economic": ("economic cost", lambda row: _number_text(row["economic_cost"])),
    "violation": ("violation", lambda row: f"{row['mean_violation']:.5f}"),
    "violating": ("violating %", lambda row: f"{100 * row['violating_share']:.2f}"),
    "week": ("violations a week [95 %]", lambda row: _estimate_cell(row, "violations_week")),
    "against": ("against", lambda row: row["against"] if isinstance(row["against"], str) else ""),
    "difference": ("difference % [95 %]", lambda row: _percent_cell(row, "difference")),
    "p": ("p", lambda row: "" if np.isnan(row["difference_p"]) else f"{row['difference_p']:.3f}"),
}
"""Columns of a scenario's table by the names that options take, of rows of the summary."""
SHORT_COLUMNS = ("case", "rank", "regret", "worst", "finished")
"""Columns that fit a terminal of 80 characters."""

AGGREGATE_TEXTS: dict[str, Text] = {
    "case": lambda row: row["case"],
    "runs": lambda row: str(row["runs"]),
    "regret %, IQM [95 %]": lambda row: _percent_cell(row, "regret_iqm"),
    "median": lambda row: _percent_cell(row, "regret_median"),
    "worst": lambda row: _percent_cell(row, "regret_worst"),
}
CASES: dict[str, Text] = {
    "case": lambda row: row["name"],
    "algorithm or controller": lambda row: row["target"],
    "samples": lambda row: str(row["samples"] or ""),
    "start": lambda row: row["start"],
    "NMPC": lambda row: row["nmpc"],
    "settings": lambda row: ", ".join(f"{k} = {json.dumps(v)}" for k, v in row["settings"].items()),
}
EVERY_RUN: dict[str, Text] = {
    "case": lambda row: row["case"],
    "scenario": lambda row: row["scenario"],
    "seed": lambda row: "" if pd.isna(row["training_seed"]) else str(row["training_seed"]),
    "status": lambda row: row["status"],
    "plant samples": lambda row: str(row["plant_samples"] or ""),
    "regret % [95 %]": lambda row: _percent_cell(row, "regret"),
    "J": lambda row: _number_text(row["J"]),
}

PAPER = {"naive": 21.0, "tuned": 15.0}
"""Gain of the paper's RL-tuned RTI-NMPC over (a) and (b), in per cent."""
NEAR = 3.0
"""Per cent within which a gain agrees with the paper's, which are approximate."""


def rendered(template: str, **context: Any) -> str:
    """A template of this folder, filled in."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=select_autoescape(["html"]),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"markdown": lambda table: markdown_table(*table), "command": shlex.join}
    return environment.get_template(template).render(context)


def texts(
    rows: Iterable[Mapping[str, Any]], columns: Mapping[str, Text]
) -> tuple[Sequence[str], list[list[str]]]:
    """A table as texts.

    Args:
        rows: the table's rows.
        columns: for each header what makes the text of a cell from its row.

    Returns:
        Header and rows.
    """
    lines = []
    for row in rows:
        lines.append([text(row) for text in columns.values()])
    return list(columns), lines


def _percent_cell(row: Mapping[str, Any], name: str, ends: str = "", digits: int = 3) -> str:
    """A share in per cent with its interval, if any; empty if undefined.

    Args:
        row: of a table.
        name: column of the share.
        ends: column of the interval, without `_low` and `_high`; default: the share's.
        digits: significant ones.
    """
    if np.isnan(row[name]):
        return ""
    low = float(row.get(f"{ends or name}_low", np.nan))
    high = float(row.get(f"{ends or name}_high", np.nan))
    interval = None if np.isnan(low) else (low, high)
    return shown(float(row[name]), interval, 100.0, digits)


def _estimate_cell(row: Mapping[str, Any], name: str) -> str:
    """A number with its interval, if any; empty if undefined."""
    if np.isnan(row[name]):
        return ""
    low = float(row[f"{name}_low"])
    high = float(row[f"{name}_high"])
    return shown(float(row[name]), None if np.isnan(low) else (low, high), digits=3)


def _number_text(value: float) -> str:
    return shown(float(value), digits=6)


def image(path: Path) -> dict[str, str]:
    """An SVG file as an `img`'s source, and its width in CSS pixels."""
    content = path.read_bytes()
    width = re.search(rb'width="([\d.]+)pt"', content)
    return {
        "source": f"data:image/svg+xml;base64,{base64.b64encode(content).decode()}",
        "width": f"{1.7 * float(width[1]):.0f}px" if width else "auto",
    }


def date(path: Path) -> str:
    """Day (UTC) on which a file of the study was written; empty without it."""
    if not path.is_file():
        return ""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).date().isoformat()


def commit() -> str:
    """Short commit of the checkout that the package is in, `+` if it was edited; else empty."""
    folder = Path(__file__).parent
    try:
        described = subprocess.run(
            ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--exclude=*"],
            capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ""
    return described.stdout.strip()
