"""A measured time and the reference that it was measured beside: rows of all benchmarks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any

import numpy as np

from cosim.cli.output import Output

HEADER = ("what", "median µs", "minimum µs", "95 % µs", "reference in the same run", "its time ×")


def _clock() -> Callable[[], float]:
    """CPU time, which a busy machine spoils least; wall time where CPU time is counted coarsely."""
    fine = time.get_clock_info("process_time").resolution <= 1e-6
    return time.process_time if fine else time.perf_counter


clock = _clock()
"""The clock of every phase, in s."""


def figure(
    name: str,
    seconds: Sequence[float],
    reference: str | None = None,
    others: Sequence[float] = (),
    *,
    at_most: float | None = None,
    at_least: float | None = None,
) -> dict[str, Any]:
    """A row: the times `seconds` of what has this name, and how many times as long others take.

    `others` are times of the `reference`, each taken beside the one of `seconds` at its place;
    `ratio` is the median of reference over own time. `at_most` is a bound on the median in µs,
    `at_least` one on the ratio; `met` says whether it holds, None without a bound.
    """
    typical = 1e6 * median(seconds)
    ratio = None
    if len(others):
        ratio = median(other / own for other, own in zip(others, seconds, strict=True))
    met = None
    if at_most is not None:
        met = typical <= at_most
    if at_least is not None:
        met = ratio is not None and ratio >= at_least
    return {
        "name": name,
        "median_us": typical,
        "minimum_us": 1e6 * min(seconds),
        "p95_us": 1e6 * float(np.quantile(seconds, 0.95)),
        "reference": reference,
        "reference_median_us": 1e6 * median(others) if len(others) else None,
        "ratio": ratio,
        "at_most_us": at_most,
        "at_least_ratio": at_least,
        "met": met,
    }


def show(title: str, rows: Sequence[Mapping[str, Any]], out_: Output) -> None:
    """Print the rows as a table, the bounds as its last column where there are any."""
    bounds = [_bound(row) for row in rows]
    header = (*HEADER, "bound") if any(bounds) else HEADER
    lines = [
        (
            str(row["name"]),
            *(f"{row[key]:.2f}" for key in ("median_us", "minimum_us", "p95_us")),
            row["reference"] or "",
            "" if row["ratio"] is None else f"{row['ratio']:.2f}",
            bound,
        )[: len(header)]
        for row, bound in zip(rows, bounds, strict=True)
    ]
    out_.table(title, header, lines)


def _bound(row: Mapping[str, Any]) -> str:
    if row["met"] is None:
        return ""
    verdict = "met" if row["met"] else "MISSED"
    if row["at_most_us"] is not None:
        return f"≤ {row['at_most_us']:g} µs: {verdict}"
    return f"≥ {row['at_least_ratio']:.2g} ×: {verdict}"
