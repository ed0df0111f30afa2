"""Store what the sweep's runs gave, in place of what is stored of the very same runs.

    python results/learning/gather.py --runs results/learning/runs

Writes to OUT: evaluation.csv (a row per controller and noise seed), runs.csv (per training run, the
commit of its code last) and curves.csv (per greedy evaluation during training). Rows of runs that
RUNS does not hold stay as they are, so a sweep may be done in parts.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
from pathlib import Path

import numpy as np
from cases import CASES
from stored import BASELINES, FIGURES, SCENARIOS, Array, rows

from cosim.evaluation.statistics import quotient
from cosim.files import write_atomically

Key = tuple[str, str, str]
"""Scenario, case or baseline, training seed (empty for a baseline)."""
COLUMNS = {
    "evaluation.csv": ("scenario", "controller", "training_seed", "seed", *FIGURES),
    "runs.csv": (
        "scenario", "case", "training_seed", "samples", "status", "J", "gap_closed", "late_rise",
        "smallest_eigenvalue", "failures", "commit",
    ),
    "curves.csv": ("scenario", "case", "training_seed", "samples", "greedy_J", "td_error"),
}  # fmt: skip


def columns(path: Path) -> dict[str, Array]:
    """Columns of a CSV of numbers; an empty cell is NaN."""
    with path.open(newline="", encoding="utf-8") as stream:
        found = list(csv.DictReader(stream))
    return {k: np.array([float(row[k]) if row[k] else np.nan for row in found]) for k in found[0]}


def cell(value: float | int | str) -> str:
    """Text of a cell; floats with eight digits."""
    return f"{value:.8g}" if isinstance(value, float) else str(value)


def late_rise(log: dict[str, Array]) -> float:
    """Worst greedy J in the last 20 % of training relative to the last one, less 1."""
    known = ~np.isnan(log["greedy_J"])
    late = known & (log["samples"] > 0.8 * log["samples"][-1])
    return float(log["greedy_J"][late].max() / log["greedy_J"][known][-1] - 1)


def evaluation(folder: Path, key: Key) -> list[list[str]]:
    """Rows of evaluation.csv of one run."""
    found = columns(folder / "evaluation.csv")
    return [
        [*key, str(int(seed)), *(cell(float(found[name][k])) for name in FIGURES)]
        for k, seed in enumerate(found["seed"])
    ]


def training(folder: Path, key: Key, naive: Array, optimum: Array) -> list[str]:
    """Row of runs.csv of one run; `naive` and `optimum` are J by noise seed."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    cost = columns(folder / "evaluation.csv")["J"]
    values = (
        int(summary["samples"]),
        summary["status"].split(":")[0],
        float(cost.mean()),
        quotient(naive - cost, naive - optimum),
        late_rise(columns(folder / "learning.csv")),
        float(summary["smallest_eigenvalue"]),
        int(summary["training_failures"]),
        summary["commit"],
    )
    return [*key, *map(cell, values)]


def curve(folder: Path, key: Key) -> list[list[str]]:
    """Rows of curves.csv of one run."""
    log = columns(folder / "learning.csv")
    return [
        [*key, *map(cell, (int(samples), float(cost), float(error)))]
        for samples, cost, error in zip(
            log["samples"], log["greedy_J"], log["td_error"], strict=True
        )
        if not np.isnan(cost)
    ]


def place(row: list[str]) -> tuple[int, int, int, int]:
    """Where a row belongs: scenario, baseline or case, training seed, noise seed or samples."""
    names = [*BASELINES, *CASES]
    return SCENARIOS.index(row[0]), names.index(row[1]), int(row[2] or 0), int(row[3])


def merge(path: Path, fresh: list[list[str]]) -> None:
    """Write a table: its stored rows, but for those of the runs that `fresh` brings."""
    header = COLUMNS[path.name]
    brought = {tuple(row[:3]) for row in fresh}
    kept: list[list[str]] = [
        [row[name] for name in header]
        for scenario in SCENARIOS
        for row in rows(path, scenario)
        if tuple(row[name] for name in header[:3]) not in brought
    ]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(sorted(kept + fresh, key=place))
    write_atomically(path, stream.getvalue())


def main() -> None:
    """Gather everything that is finished."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("results/learning/runs"))
    parser.add_argument("--out", type=Path, default=Path("results/learning"))
    arguments = parser.parse_args()
    evaluations: list[list[str]] = []
    runs: list[list[str]] = []
    curves: list[list[str]] = []
    for scenario in SCENARIOS:
        home = arguments.runs / scenario
        for name in BASELINES:
            evaluations += evaluation(home / name, (scenario, name, ""))
        naive, optimum = (columns(home / n / "evaluation.csv")["J"] for n in ("naive", "optimal"))
        for case in CASES:
            for path in sorted((home / case).glob("*/evaluation.csv")):
                key = (scenario, case, str(int(path.parent.name)))
                evaluations += evaluation(path.parent, key)
                runs.append(training(path.parent, key, naive, optimum))
                curves += curve(path.parent, key)
    merge(arguments.out / "evaluation.csv", evaluations)
    merge(arguments.out / "runs.csv", runs)
    merge(arguments.out / "curves.csv", curves)


if __name__ == "__main__":
    main()
