"""Learning in operation: θ at given times, and what a run's samples cost until then."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import process_time
from typing import NamedTuple

import numpy as np
from scipy.stats import ttest_1samp

from controllers import compile_functions
from controllers.estimator import measured
from controllers.factories import build_controller, nmpc
from controllers.optimum import QuasiStaticPolicy, fouling, frozen
from cosim.core.errors import StudyError
from cosim.core.protocols import Array, Controller
from cosim.core.scenario import VIOLATING, Scenario
from cosim.core.simulation import simulate
from cosim.plant import FmuPlant
from learning.algorithm import load_algorithm
from learning.errors import DivergenceError
from learning.log import LogRow
from learning.training_run import TrainingRun, begin_training

THETA_PREFIX = "theta "
"""Of the columns of a log that hold θ."""
WINDOW = 100
"""Samples in a row of the worst window."""
SHIFT = 480
"""Samples in a row, eight hours of a minute each, that are compared with those of the start."""
SHIFT_PARTS = 8
"""Parts of a shift, whose means are the values of its test; fewer where noise has a long memory."""
PART_MEMORIES = 10
"""Time constants of the noise that a part has at least: neighbours then correlate by 0.06."""
SHIFT_LEVEL = 0.05
"""Level of the test, of all shifts of a run together."""
OPERATION_METRICS = [
    "J",
    "violating",
    "dearest",
    "first_change",
    "updates",
    "model_samples",
    "dearer",
    "excess",
]
"""Columns of operation.csv."""


def plant_at(scenario: Scenario, time: float) -> Scenario:
    """The scenario with its plant frozen at a time.

    Args:
        scenario: of a plant that may change with time.
        time: in s.
    """
    moving_parameter = fouling(scenario)
    if moving_parameter is None:
        return scenario.at(time)
    name, value_at = moving_parameter
    value = float(value_at(time))
    return frozen(scenario, name, value)


def optimum_at(scenario: Scenario, sample: int) -> Controller:
    """The optimal policy of the plant frozen at a sample.

    Args:
        scenario: of a plant that may change with time.
        sample: number of the sample.
    """
    time = sample * scenario.sampling_time
    if fouling(scenario) is None:
        return build_controller("optimal", plant_at(scenario, time))
    moving = QuasiStaticPolicy.from_scenario(scenario)
    position = moving.law.position(time)
    # The plant stands still from here on: its position no longer depends on the time.
    standing_law = replace(moving.law, position=lambda _: position)
    return QuasiStaticPolicy(
        standing_law,
        moving.policies,
        scenario.sampling_time,
    )


@dataclass(frozen=True)
class OperationRun:
    """A training from one plant sample to the next, without a reset.

    Attributes:
        rows: `OPERATION_METRICS` and θ at each mark.
        status: `finished` or `diverged: …`.
        processor_seconds: time that the training took up to each mark, in s.
        plant_samples: samples that were taken of the plant.
    """

    rows: list[LogRow]
    status: str
    processor_seconds: dict[int, float]
    plant_samples: int


def run_in_operation(run: TrainingRun, marks: Sequence[int]) -> OperationRun:
    """Take the samples of a training on its plant, and its metrics after some of them.

    Args:
        run: the training; its `samples` is the last mark.
        marks: numbers of samples after which metrics and θ are kept, increasing.

    Returns:
        The run; the cost of each sample since it has diverged is infinite.
    """
    # What a sample costs after a divergence.
    cost = np.full(run.samples, np.inf)
    violating = np.ones(run.samples, dtype=bool)
    rows: list[LogRow] = []
    processor_seconds: dict[int, float] = {}
    status = "finished"
    first_change = 0
    n_updates = 0
    with FmuPlant(run.scenario) as plant:
        # What the start's θ costs in the same samples, on the same noise.
        before = _cost_of_the_start(run, plant)
        loop = begin_training(run, load_algorithm(run.algorithm), plant)
        clock = process_time()
        compile_functions(loop.law, run.samples)
        start_theta = loop.controller.theta.copy()
        for k in range(run.samples):
            n_samples = k + 1
            if status == "finished":
                violation = float(loop.penalty.violation(loop.s).sum())
                violating[k] = violation > VIOLATING
                try:
                    cost[k], update = loop.advance()
                    if update is not None:
                        n_updates += 1
                    # An update may be refused, and θ then stays.
                    has_moved = not np.array_equal(start_theta, loop.controller.theta)
                    if has_moved and not first_change:
                        first_change = n_samples
                except DivergenceError as error:
                    status = f"diverged: {error} at sample {n_samples}"
            if n_samples not in marks:
                continue
            processor_seconds[n_samples] = process_time() - clock
            metrics = operation_metrics(
                n_samples,
                before,
                cost,
                violating,
                first_change,
                run.scenario.memory,
            )
            # A rule without a model of its own has no samples of it.
            model_samples = getattr(loop.algorithm, "model_samples", 0)
            metrics["updates"] = float(n_updates)
            metrics["model_samples"] = float(model_samples)
            rows.append(LogRow(metrics, loop.parameters))
        return OperationRun(rows, status, processor_seconds, loop.counts.number)


def _cost_of_the_start(run: TrainingRun, plant: FmuPlant) -> Array:
    """Cost (K,) of each sample of a run if θ stayed as it starts."""
    controller = nmpc(run.scenario, run.starting_parameters(), run.controller)
    law = measured(run.scenario, controller)
    compile_functions(law, run.samples)
    signals = simulate(plant, law, run.samples, run.seed, residuals=False).signals
    return signals["stage_cost"].values + signals["penalty"].values


def operation_metrics(
    samples: int,
    before: Array,
    cost: Array,
    violating: Array,
    first_change: int,
    memory: float = 0.0,
) -> dict[str, float]:
    """Costs of the first samples of a run in operation.

    Args:
        samples: Number of the run's samples so far.
        before: Cost (K,) that the start's θ has in each sample of the run, on the same noise.
        cost: Cost (K,) of each sample.
        violating: Whether each sample violates a bound, (K,).
        first_change: Number of samples before the first one with another θ; 0 while θ stays.
        memory: Longest time constant of the noise, in samples (`Scenario.memory`).

    Returns:
        `samples`; `J`, the mean cost of all of them; `first_change`, NaN while θ stays; of the
        samples since then (of all, while θ stays) the share of `violating` ones and `dearest`, the
        mean cost of the worst window; `dearer` and `excess`, the number and the excess of
        `compare_shifts`, NaN while θ stays. A metric of no sample is NaN.
    """
    since = slice(first_change, samples)
    metrics = {
        "samples": float(samples),
        "J": float(cost[:samples].mean()),
        "violating": np.nan,
        "dearest": worst_window(cost[since]),
        "first_change": np.nan,
        "dearer": np.nan,
        "excess": np.nan,
    }
    if first_change < samples:
        metrics["violating"] = float(violating[since].mean())
    if first_change > 0:
        metrics["first_change"] = float(first_change)
        shifts = compare_shifts(before[since], cost[since], memory)
        metrics["dearer"] = shifts.higher
        metrics["excess"] = shifts.largest_excess
    return metrics


def worst_window(cost: Array) -> float:
    """Largest mean cost of `WINDOW` samples in a row.

    Args:
        cost: of each sample, (K,).

    Returns:
        The mean; of all samples where there are fewer, infinite after a divergence, NaN of none.
    """
    if not len(cost):
        return float("nan")
    if not np.isfinite(cost).all():
        return float("inf")
    width = min(WINDOW, len(cost))
    # The sum over a window is a difference of sums from the start, which begin with 0.
    sums = np.append(0.0, np.cumsum(cost))
    window_sums = sums[width:] - sums[:-width]
    return float(window_sums.max() / width)


class ShiftComparison(NamedTuple):
    """Number of shifts whose cost is higher than before, and the largest excess of a mean."""

    higher: float
    largest_excess: float


def compare_shifts(before: Array, cost: Array, memory: float = 0.0) -> ShiftComparison:
    """Compare costs of the same noise, shift by shift of `SHIFT` samples.

    A shift's cost is higher where the excess of its `SHIFT_PARTS` is above zero by a one-sided
    t test at `SHIFT_LEVEL` (Bonferroni over the shifts). The test takes the parts as independent:
    where the noise has a memory they are longer, and fewer. Samples behind the last whole shift do
    not count.

    Args:
        before: cost of each sample that is compared with, (K,).
        cost: cost of each sample, (K,); infinite after a divergence.
        memory: longest time constant of the noise, in samples.

    Returns:
        The comparison; NaN where there is no whole shift. `higher` is NaN where a shift is too
        short for two independent parts.
    """
    n_shifts = len(cost) // SHIFT
    if not n_shifts:
        return ShiftComparison(np.nan, np.nan)
    n_parts = SHIFT_PARTS
    # Halved until a part is long enough, so that the parts of a shift stay equal.
    while n_parts > 1 and SHIFT / n_parts < PART_MEMORIES * memory:
        n_parts //= 2
    whole_shifts = slice(0, n_shifts * SHIFT)
    # Of infinite costs a test has no value: they count by their mean.
    with np.errstate(invalid="ignore", divide="ignore"):
        excess = cost[whole_shifts] - before[whole_shifts]
        # Means of parts are nearly independent where neighbouring samples are not.
        parts = excess.reshape(n_shifts, n_parts, -1).mean(axis=2)
        mean_excess = parts.mean(axis=1)
        if n_parts == 1:
            # The spread of one part is unknown.
            return ShiftComparison(np.nan, float(mean_excess.max()))
        p = ttest_1samp(parts, 0.0, axis=1, alternative="greater").pvalue
    # Bonferroni: one shift in twenty runs without an excess is found to be higher, not in each.
    is_significant = p < SHIFT_LEVEL / n_shifts
    is_higher = is_significant | (mean_excess == np.inf)
    n_higher = float(is_higher.sum())
    largest_excess = float(mean_excess.max())
    return ShiftComparison(n_higher, largest_excess)


def theta_at(log: str, mark: int) -> tuple[float, ...]:
    """The final θ of a run, had it ended earlier.

    Args:
        log: text of its learning.csv.
        mark: number of samples, one that the log has a row of.

    Returns:
        θ, (n_θ,).
    """
    for row in csv.DictReader(log.splitlines()):
        if int(row["samples"]) != mark:
            continue
        # Columns come in the order of θ.
        theta = []
        for name, cell in row.items():
            if name.startswith(THETA_PREFIX):
                theta.append(float(cell))
        return tuple(theta)
    raise StudyError(f"a log of a run in operation has no row of {mark} samples")
