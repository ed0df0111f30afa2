"""The stored tables of the sweep, read: baselines and training runs of a scenario."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cases import CASES
from numpy.typing import NDArray

from cosim.evaluation.statistics import Estimate, ratio

Array = NDArray[np.float64]
Figures = dict[str, Array]
"""Indicators by held-out noise seed, (seeds,) each, and the seeds themselves as `seed`."""

SCENARIOS = ("paper", "fast-sampling")
BASELINES = ("naive", "tuned", "optimal")
FIGURES = ("J", "economic_cost", "mean_violation", "violating_share", "failures")


@dataclass(frozen=True)
class Run:
    """A training run: its seed, its row of runs.csv and the evaluation of its final θ."""

    seed: int
    record: dict[str, str]
    figures: Figures

    @property
    def cost(self) -> float:
        """Mean J over the held-out seeds."""
        return float(self.figures["J"].mean())


@dataclass(frozen=True)
class Stored:
    """Baselines by name, and the runs of each case in the order of their seeds."""

    baselines: dict[str, Figures]
    cases: dict[str, list[Run]]

    def gap(self, cost: Array) -> Estimate:
        """Gap closed with its interval, paired over the held-out seeds of `cost` (seeds,)."""
        naive, optimum = (self.baselines[name]["J"][: len(cost)] for name in ("naive", "optimal"))
        return ratio(naive - cost, naive - optimum)


def rows(path: Path, scenario: str) -> list[dict[str, str]]:
    """Rows of a stored table that belong to a scenario."""
    with path.open(newline="", encoding="utf-8") as stream:
        return [row for row in csv.DictReader(stream) if row["scenario"] == scenario]


def load(folder: Path, scenario: str) -> Stored:
    """What the folder's evaluation.csv and runs.csv hold of a scenario."""
    evaluations: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in rows(folder / "evaluation.csv", scenario):
        evaluations.setdefault((row["controller"], row["training_seed"]), []).append(row)
    figures = {
        key: {name: np.array([float(row[name]) for row in found]) for name in ("seed", *FIGURES)}
        for key, found in evaluations.items()
    }
    cases: dict[str, list[Run]] = {}
    for record in rows(folder / "runs.csv", scenario):
        case, seed = record["case"], record["training_seed"]
        cases.setdefault(case, []).append(Run(int(seed), record, figures[case, seed]))
    return Stored(
        {name: figures[name, ""] for name in BASELINES},
        {case: cases[case] for case in CASES if case in cases},
    )
