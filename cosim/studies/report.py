"""A study's report: one HTML page that needs nothing else, and the same tables as Markdown."""

from __future__ import annotations

import base64
import json
import re
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader, select_autoescape

from cosim.protocols import Array
from cosim.result import TextTable, markdown_table
from cosim.statistics import gain, shown

PAGE, TABLES, FOLDER = "report.html", "report.md", "figures"
Rows = tuple[Sequence[str], list[list[str]]]
"""Header and rows of texts."""

COLUMNS: dict[str, tuple[str, Callable[[Mapping[str, Any]], str]]] = {
    "case": ("case", lambda row: row["case"]),
    "rank": ("rank", lambda row: str(row["rank"])),
    "samples": ("plant samples", lambda row: str(row["plant_samples"] or "")),
    "finished": (
        "finished",
        lambda row: f"{row['finished']}/{row['runs']}" if row["samples"] else "",
    ),
    "regret": (
        "regret %, median [95 %]",
        lambda row: _percent(row, "regret_median", "regret_wide"),
    ),
    "worst": ("worst", lambda row: _percent(row, "regret_worst") if row["runs"] > 1 else ""),
    "iqm": ("IQM [95 %]", lambda row: _percent(row, "regret_iqm") if row["runs"] > 1 else ""),
    "J": ("J, median", lambda row: _number(row["J_median"])),
    "J-worst": ("J, worst", lambda row: _number(row["J_worst"]) if row["runs"] > 1 else ""),
    "gap": ("gap closed %", lambda row: _percent(row, "gap_closed_median", digits=4)),
    "economic": ("economic cost", lambda row: _number(row["economic_cost"])),
    "violation": ("violation", lambda row: f"{row['mean_violation']:.5f}"),
    "violating": ("violating %", lambda row: f"{100 * row['violating_share']:.2f}"),
    "against": ("against", lambda row: row["against"] if isinstance(row["against"], str) else ""),
    "difference": ("difference % [95 %]", lambda row: _percent(row, "difference")),
    "p": ("p", lambda row: "" if np.isnan(row["difference_p"]) else f"{row['difference_p']:.3f}"),
}
"""Columns of a scenario's table by the names that options take: header, text of a summary's row."""
SHORT = ("case", "rank", "regret", "worst", "finished")
"""Columns that fit a terminal of 80 characters."""

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
    environment.filters |= {
        "markdown": lambda table: markdown_table(table[1], table[2]),
        "command": shlex.join,
    }
    return environment.get_template(template).render(context)


def _percent(row: Mapping[str, Any], name: str, ends: str = "", digits: int = 3) -> str:
    """A share in per cent with its interval, if any; empty if undefined."""
    low, high = (float(row.get(f"{ends or name}_{end}", np.nan)) for end in ("low", "high"))
    if np.isnan(row[name]):
        return ""
    return shown(float(row[name]), None if np.isnan(low) else (low, high), 100.0, digits)


def _number(value: float) -> str:
    return shown(float(value), None, 1.0, 6)


def aggregate_table(aggregate: pd.DataFrame) -> Rows:
    """Header and rows of the table over all scenarios."""
    names = ("regret_iqm", "regret_median", "regret_worst")
    return ("case", "runs", "regret %, IQM [95 %]", "median", "worst"), [
        [row["case"], str(row["runs"]), *(_percent(row, name) for name in names)]
        for row in aggregate.to_dict("records")
    ]


def case_table(cases: Mapping[str, Mapping[str, Any]]) -> Rows:
    """Header and rows of the cases."""
    return ("case", "algorithm or controller", "samples", "start", "NMPC", "settings"), [
        [
            name, case["target"], str(case["samples"] or ""), case["start"], case["nmpc"],
            ", ".join(f"{key} = {json.dumps(v)}" for key, v in case["settings"].items()),
        ]
        for name, case in cases.items()
    ]  # fmt: skip


def run_table(runs: pd.DataFrame) -> Rows:
    """Header and rows of every run."""
    return ("case", "scenario", "seed", "status", "plant samples", "regret % [95 %]", "J"), [
        [
            row["case"], row["scenario"],
            "" if pd.isna(row["training_seed"]) else str(row["training_seed"]), row["status"],
            str(row["plant_samples"] or ""), _percent(row, "regret"), _number(row["J"]),
        ]
        for row in runs.to_dict("records")
    ]  # fmt: skip


def paper_table(
    scenarios: Sequence[str], trained: Sequence[str], indicator: Callable[[str, str, str], Array]
) -> TextTable:
    """Title, header and rows: gains of each trained case's median run on every scenario.

    `indicator` maps case, scenario and name to values (R, S) of runs on noise seeds. The paper's
    two gains imply J(b)/J(a) = (1 − 0.21)/(1 − 0.15) = 0.93.
    """
    rows = []
    for scenario, case in product(scenarios, trained):
        bases = [indicator(name, scenario, "J") for name in PAPER]
        cost = indicator(case, scenario, "J")
        if not all(map(len, (*bases, cost))):
            continue
        order = np.argsort(cost.mean(axis=1), kind="stable")
        middle = order[(len(order) - 1) // 2]
        gains = [
            gain(indicator(case, scenario, name)[middle], indicator(base, scenario, name)[0])
            for name in ("J", "economic_cost")
            for base in PAPER
        ]
        agrees = [
            f"({letter})"
            for letter, found, wanted in zip("ab", gains[:2], PAPER.values(), strict=True)
            if abs(100 * found.value - wanted) <= NEAR
        ]
        ratio = bases[1].mean() / bases[0].mean()
        texts = (shown(one.value, one.interval, 100.0, 3) for one in gains)
        best = _number(cost[middle].mean())
        rows.append([scenario, case, f"{ratio:.3f}", best, *texts, " and ".join(agrees)])
    title = (
        "Gains over the baselines: the paper's text states about 21 % over (a) and 15 % over (b)"
    )
    header = (
        "scenario", "case", "J(b)/J(a)", "J, median", "gain over (a) %", "gain over (b) %",
        "economic over (a) %", "economic over (b) %", "agrees with the paper on",
    )  # fmt: skip
    return title, header, rows


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
        found = subprocess.run(
            ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--exclude=*"],
            capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ""
    return found.stdout.strip()
