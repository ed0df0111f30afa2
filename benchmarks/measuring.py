"""The clock of all benchmarks, and a measured time beside its reference as a row of a table."""

import time
from statistics import median

import numpy as np

# CPU time, which a busy machine spoils least; wall time where CPU time is counted coarsely.
FINE = time.get_clock_info("process_time").resolution <= 1e-6
clock = time.process_time if FINE else time.perf_counter
HEADER = ("what", "median µs", "least µs", "95 % µs", "reference in the same run", "its time ×")


def figure(name, seconds, reference=None, others=(), *, at_most=None, at_least=None):
    """A row: the times `seconds` of `name`, and how many times as long those of `reference` are.

    `others` are the reference's times, each measured beside the one of `seconds` at its place;
    `ratio` is the median of reference over own time. `at_most` bounds the median in µs, `at_least`
    the ratio; `met` says whether the bound holds, None without one.
    """
    typical = 1e6 * median(seconds)
    ratio = median(b / a for a, b in zip(seconds, others, strict=True)) if len(others) else None
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
        "ratio": ratio,
        "at_most_us": at_most,
        "at_least_ratio": at_least,
        "met": met,
    }


def cells(row):
    """A row as text, its bound behind its reference."""
    bound = f"≤ {row['at_most_us']} µs" if row["at_most_us"] else ""
    bound = f"≥ {row['at_least_ratio']:.2g} ×" if row["at_least_ratio"] else bound
    if bound:
        bound = f"({bound}: {'met' if row['met'] else 'MISSED'})"
    return (
        row["name"],
        *(f"{row[key]:.2f}" for key in ("median_us", "minimum_us", "p95_us")),
        " ".join([row["reference"] or "", bound]).strip(),
        "" if row["ratio"] is None else f"{row['ratio']:.2f}",
    )
