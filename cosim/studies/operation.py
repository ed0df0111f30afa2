"""Learning in operation: a run's life on a plant that is not reset, and the plant at a time."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from time import process_time

import numpy as np
from scipy.stats import ttest_1samp

from controllers import compile_functions
from controllers.optimum import Fouling, QuasiStaticPolicy, change_of
from cosim.plant import FmuPlant
from cosim.plugins import build_controller
from cosim.protocols import Array, Controller
from cosim.scenario import VIOLATING, Scenario
from learning.algorithm import load_algorithm
from learning.baselines import Held
from learning.errors import DivergenceError
from learning.training import LogRow, TrainingRun, begin

WINDOW = 100
"""Samples in a row of which the dearest are reported."""
SHIFT, PARTS, LEVEL = 480, 8, 0.05
"""Samples in a row that are compared with those of the start, in how many parts, at which level."""
LIFE = [
    "J", "violating", "dearest", "first_change", "updates", "model_samples", "dearer", "excess",
]  # fmt: skip


def plant_at(scenario: Scenario, time: float) -> Scenario:
    """The scenario of a plant that stays as it is at a time in s."""
    law = change_of(scenario)
    if isinstance(law, Fouling):
        return scenario.replace(
            {"plant": {"parameters": law.present(time) | {"fouling_rate": 0.0}}}
        )
    return scenario.at(time)


class StoppedPolicy(QuasiStaticPolicy):
    """The reference of a plant that fouls, its clock stopped at a `sample`."""

    sample = 0

    def prepare(self) -> None:
        """Leave the clock where it stopped."""
        self._sample = self.sample


def optimum_at(scenario: Scenario, sample: int) -> Controller:
    """The optimal policy of the plant as it is at a sample."""
    if not isinstance(change_of(scenario), Fouling):
        return build_controller("optimal", plant_at(scenario, sample * scenario.sampling_time))
    moving = QuasiStaticPolicy.from_scenario(scenario)
    found = StoppedPolicy(moving.law, moving.policies, scenario.sampling_time)
    found.sample = sample
    return found


def live(run: TrainingRun, marks: Sequence[int]) -> tuple[list[LogRow], str, dict[int, float], int]:
    """Take the samples of a run on its plant; rows of `LIFE` and θ after each of the `marks`.

    Also the status, the processor time in s by mark, and the plant samples taken. `J` is the mean
    cost of all samples so far; since the first change of θ (since the start, where θ rests)
    `violating` is the share of violating samples and `dearest` the largest mean cost of `WINDOW`
    samples in a row; `dearer` and `excess` compare with θ as it starts (`dearer_than`). A run that
    diverges keeps its θ, and costs without bound from there on.
    """
    cost, violating = np.full(run.samples, np.inf), np.ones(run.samples, dtype=bool)
    rows: list[LogRow] = []
    clock: dict[int, float] = {}
    status, first, updates = "finished", 0, 0
    with FmuPlant(run.scenario) as plant:
        held = begin(run, Held, plant)
        compile_functions(held.controller, run.samples)
        before = np.array([held.advance()[0] for _ in range(run.samples)])
        loop, start = begin(run, load_algorithm(run.algorithm), plant), process_time()
        compile_functions(loop.controller, run.samples)
        theta, penalty = loop.controller.theta.copy(), run.scenario.state_penalty
        for k in range(run.samples):
            if status == "finished":
                violating[k] = float(penalty.violation(loop.s).sum()) > VIOLATING
                try:
                    cost[k], update = loop.advance()
                    updates += update is not None
                    if not first and not np.array_equal(theta, loop.controller.theta):
                        first = k + 1
                except DivergenceError as error:
                    status = f"diverged: {error} at sample {k + 1}"
            if k + 1 not in marks:
                continue
            clock[k + 1] = process_time() - start
            since = violating[first : k + 1]
            dearer, excess = dearer_than(before[first : k + 1], cost[first : k + 1])
            figures = {
                "samples": k + 1,
                "J": float(cost[: k + 1].mean()),
                "violating": float(since.mean()) if len(since) else np.nan,
                "dearest": dearest(cost[first : k + 1]),
                "first_change": first or np.nan,
                "updates": updates,
                "model_samples": int(getattr(loop.algorithm, "model_samples", 0)),
                "dearer": dearer if first else np.nan,
                "excess": excess if first else np.nan,
            }
            rows.append(LogRow(figures, loop.parameters))
        return rows, status, clock, loop.counts.number


def dearest(cost: Array) -> float:
    """Largest mean of `WINDOW` samples in a row of K, (K,); of all where there are fewer."""
    if not np.isfinite(cost).all() or not len(cost):
        return float("inf") if len(cost) else float("nan")
    width = min(WINDOW, len(cost))
    total = np.concatenate([[0.0], np.cumsum(cost)])
    return float((total[width:] - total[:-width]).max() / width)


def dearer_than(before: Array, cost: Array) -> tuple[float, float]:
    """Number of shifts that are dearer than `before`, and the largest excess of a shift's mean.

    Costs (K,) of the same noise, in shifts of `SHIFT` samples; NaN where there is none. A shift is
    dearer where the excess of its `PARTS` is above zero by Student's t; the chance that any is
    called so by noise alone is `LEVEL` (Bonferroni).
    """
    shifts = len(cost) // SHIFT
    if not shifts:
        return np.nan, np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = (cost - before)[: shifts * SHIFT].reshape(shifts, PARTS, -1).mean(axis=2)
        p = ttest_1samp(parts, 0.0, axis=1, alternative="greater").pvalue
    mean = parts.mean(axis=1)
    return float(((p < LEVEL / shifts) | (mean == np.inf)).sum()), float(mean.max())


def theta_at(log: str, mark: int) -> tuple[float, ...]:
    """θ that a run would have handed over after `mark` samples, from the text of its log."""
    rows = csv.DictReader(log.splitlines())
    row = next(row for row in rows if int(row["samples"]) == mark)
    return tuple(float(value) for name, value in row.items() if name.startswith("theta "))
