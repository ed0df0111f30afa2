"""Learning in operation: θ at given times, and the cost of a run's samples until then."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import process_time
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import ttest_1samp

from controllers import compile_functions
from controllers.estimator import measured
from controllers.factories import nmpc
from controllers.optimum import QuasiStaticPolicy, fouling, frozen
from cosim.core.errors import StudyError
from cosim.core.plugins import build_controller
from cosim.core.protocols import Array, Controller
from cosim.core.result import TextTable
from cosim.core.scenario import VIOLATING, Scenario
from cosim.core.simulation import simulate
from cosim.core.statistics import (
    Estimate,
    Interval,
    median_over_runs,
    paired_difference,
    regrets,
    relative,
    shown,
    two_way,
)
from cosim.plant import FmuPlant
from cosim.studies.ranks import shared_ranks
from learning.algorithm import load_algorithm
from learning.errors import DivergenceError
from learning.log import LogRow
from learning.training_run import TrainingRun, begin_training

WEEK = 7 * 86400.0
"""Seconds of a week."""
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
    "J", "violating", "dearest", "first_change", "updates", "model_samples", "dearer", "excess",
]  # fmt: skip
"""Columns of operation.csv."""


def plant_at(scenario: Scenario, time: float) -> Scenario:
    """The scenario with its plant frozen at a time in s."""
    if fouled := fouling(scenario):
        name, value = fouled
        return frozen(scenario, name, float(value(time)))
    return scenario.at(time)


def optimum_at(scenario: Scenario, sample: int) -> Controller:
    """The optimal policy of the plant frozen at a sample."""
    time = sample * scenario.sampling_time
    if fouling(scenario) is None:
        return build_controller("optimal", plant_at(scenario, time))
    moving = QuasiStaticPolicy.from_scenario(scenario)
    # The plant stands still from here on: its position no longer depends on the time.
    where = moving.law.position(time)
    law = replace(moving.law, position=lambda _: where)
    return QuasiStaticPolicy(law, moving.policies, scenario.sampling_time)


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
    cost = np.full(run.samples, np.inf)
    violating = np.ones(run.samples, dtype=bool)
    rows: list[LogRow] = []
    processor_seconds: dict[int, float] = {}
    status = "finished"
    first_change = 0
    updates = 0
    with FmuPlant(run.scenario) as plant:
        # What the start's θ costs in the same samples, on the same noise.
        before = _cost_of_the_start(run, plant)
        loop = begin_training(run, load_algorithm(run.algorithm), plant)
        clock = process_time()
        compile_functions(loop.controller, run.samples)
        start_theta = loop.controller.theta.copy()
        penalty = run.scenario.state_penalty
        for k in range(run.samples):
            if status == "finished":
                violating[k] = float(penalty.violation(loop.s).sum()) > VIOLATING
                try:
                    cost[k], update = loop.advance()
                    if update is not None:
                        updates += 1
                    if not first_change and not np.array_equal(start_theta, loop.controller.theta):
                        first_change = k + 1
                except DivergenceError as error:
                    status = f"diverged: {error} at sample {k + 1}"
            if k + 1 not in marks:
                continue
            processor_seconds[k + 1] = process_time() - clock
            metrics = operation_metrics(
                k + 1, before, cost, violating, first_change, run.scenario.memory
            )
            metrics["updates"] = float(updates)
            metrics["model_samples"] = float(getattr(loop.algorithm, "model_samples", 0))
            rows.append(LogRow(metrics, loop.parameters))
        return OperationRun(rows, status, processor_seconds, loop.counts.number)


def _cost_of_the_start(run: TrainingRun, plant: FmuPlant) -> Array:
    """Cost (K,) of each sample of a run if θ stayed as it starts."""
    controller = nmpc(run.scenario, run.starting_parameters(), run.controller)
    compile_functions(controller, run.samples)
    law = measured(run.scenario, controller)
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
    """What the first samples of a run in operation cost.

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
            return ShiftComparison(np.nan, float(mean_excess.max()))
        p = ttest_1samp(parts, 0.0, axis=1, alternative="greater").pvalue
    # Bonferroni: one shift in twenty runs without an excess is found to be higher, not in each.
    is_significant = p < SHIFT_LEVEL / n_shifts
    is_higher = is_significant | (mean_excess == np.inf)
    return ShiftComparison(float(is_higher.sum()), float(mean_excess.max()))


def theta_at(log: str, mark: int) -> tuple[float, ...]:
    """The final θ of a run, had it ended earlier.

    Args:
        log: text of its learning.csv.
        mark: number of samples, one that the log has a row of.

    Returns:
        θ, (n_θ,).
    """
    for row in csv.DictReader(log.splitlines()):
        if int(row["samples"]) == mark:
            return tuple(float(row[name]) for name in row if name.startswith("theta "))
    raise StudyError(f"a log of a run in operation has no row of {mark} samples")


@dataclass(frozen=True)
class OperationResult:
    """Regrets of all runs in operation on one scenario.

    Attributes:
        greedy: J of the greedy policy by case and mark, a row for each training seed and a column
            for each seed of the noise, (R, S).
        optimum: J* (S,) on the same noise by mark.
        runs: a row for each run and mark: `OPERATION_METRICS` with `dearest` as a regret and
            `excess` as a share of J*; `regret` of the greedy policy; `life_regret` of the whole
            run.
    """

    greedy: dict[str, dict[int, pd.DataFrame]]
    optimum: dict[int, Array]
    runs: pd.DataFrame


def operation_result(runs: pd.DataFrame, greedy: pd.DataFrame, optimum: str) -> OperationResult:
    """Regrets of the runs on one scenario; without an optimum, against the best case at the time.

    Args:
        runs: rows of operation.csv.
        greedy: rows of greedy.csv.
        optimum: name of the case whose J is J*; another name if there is none.
    """
    costs = _greedy_costs(greedy)
    optimal_costs = costs.pop(optimum, None)
    # A run's noise is that of its training seed, for as many samples.
    same_noise = ["training_seed", "samples"]
    if optimal_costs is not None:
        best = {mark: table.to_numpy()[0] for mark, table in optimal_costs.items()}
        best_run = runs[runs.case == optimum].set_index(same_noise).J
    else:
        best = _best_costs(costs, runs.samples.unique().tolist())
        best_run = runs.groupby(same_noise).J.min()
    run_key = ["case", *same_noise]
    greedy_mean = greedy.groupby(run_key).J.mean()
    greedy_J = greedy_mean.rename("greedy_J").reset_index()
    rows = runs[runs.case != optimum]
    rows = rows.merge(best_run.rename("optimal_J"), on=same_noise, how="left")
    rows = rows.merge(greedy_J, on=run_key, how="left")
    # The greedy policies of a mark share its noise, the whole runs of a training seed theirs.
    optimal_greedy = {mark: float(cost.mean()) for mark, cost in best.items()}
    optimal_greedy_J = rows.samples.map(optimal_greedy).to_numpy()
    rows["regret"] = regrets(rows.greedy_J.to_numpy(), optimal_greedy_J)
    optimal_J = rows.optimal_J.to_numpy()
    rows["life_regret"] = regrets(rows.J.to_numpy(), optimal_J)
    rows["dearest"] = regrets(rows.dearest.to_numpy(), optimal_J)
    rows["excess"] = relative(rows.excess.to_numpy(), optimal_J)
    return OperationResult(costs, best, rows)


def _best_costs(
    costs: Mapping[str, Mapping[int, pd.DataFrame]], marks: Sequence[int]
) -> dict[int, Array]:
    """Greedy J (S,) of the best case at each mark, its mean over the training seeds.

    Args:
        costs: greedy J of each case by mark, (R, S).
        marks: samples of operation.
    """
    best = {}
    for mark in marks:
        means = []
        for tables in costs.values():
            if mark in tables:
                means.append(tables[mark].to_numpy().mean(axis=0))
        best[mark] = min(means, key=np.mean)
    return best


def _greedy_costs(greedy: pd.DataFrame) -> dict[str, dict[int, pd.DataFrame]]:
    """J by case and mark, (R, S): see `OperationResult.greedy`."""
    costs: dict[str, dict[int, pd.DataFrame]] = {}
    for (case, samples), rows in greedy.groupby(["case", "samples"], sort=False):
        # A controller has no training seed, and one row.
        numbered = rows.assign(run=rows.training_seed.fillna(-1))
        table = numbered.pivot(index="run", columns="seed", values="J")
        costs.setdefault(case, {})[int(samples)] = table
    return costs


def duration(seconds: float) -> str:
    """A time of operation in words of a calendar: `8 h`, `7 d`."""
    day = seconds / 86400.0
    return f"{day:.3g} d" if day >= 1.0 else f"{seconds / 3600.0:.3g} h"


@dataclass(frozen=True)
class OperationLayout:
    """What the tables and the figure of a scenario in operation show.

    Attributes:
        sampling_time: of the plant, in s.
        columns: marks that tables show.
        drawn: cases that the figure shows; empty: all.
    """

    sampling_time: float
    columns: Sequence[int]
    drawn: Sequence[str] = ()

    @property
    def times(self) -> list[str]:
        """The columns as times of operation."""
        return [duration(mark * self.sampling_time) for mark in self.columns]


def operation_tables(
    result: OperationResult,
    scenario: str,
    layout: OperationLayout,
    against: Mapping[str, str | None],
    seconds: Mapping[str, float],
) -> Iterator[TextTable]:
    """Title, header and rows of a scenario's tables.

    Args:
        result: the regrets of all runs.
        scenario: its name.
        layout: what the tables show.
        against: the counterpart of each case, None where it has none.
        seconds: processor time in s of a case, up to the last column.
    """
    title = "Greedy regret in % of the final θ of a run that ends then, median [95 %] (worst)"
    rows = _greedy_rows(result, layout.columns)
    yield f"{title}: `{scenario}`", ("case", "rank at the end", *layout.times), rows
    title = "Regret in % of the run so far, exploration included, median [95 %] (worst)"
    rows = _run_rows(result.runs, layout.columns)
    yield f"{title}: `{scenario}`", ("case", *layout.times), rows
    end = result.runs[result.runs.samples == layout.columns[-1]]
    header = (
        "case", "runs", "first change, samples", "violating % since", "violations a week [95 %]",
        "dearest 100 samples %", "updates", "model samples", "processor s",
    )  # fmt: skip
    title = f"What {layout.times[-1]} of operation took on `{scenario}`, medians"
    yield title, header, _effort_rows(end, seconds, WEEK / layout.sampling_time)
    if rows := _shift_rows(end):
        title = (
            f"Shifts of {SHIFT} samples dearer than θ as it starts, median (worst): `{scenario}`"
        )
        yield title, ("case", "runs", "shifts", "largest excess %"), rows
    if rows := _difference_rows(result, layout.columns, against):
        title = f"Greedy regret less the counterpart's, percentage points [95 %]: `{scenario}`"
        yield title, ("case", *layout.times), rows


def _greedy_rows(result: OperationResult, marks: Sequence[int]) -> list[list[str]]:
    """Rank, and greedy regret with its interval over training seeds and noise, of each case."""
    ranks = _ranks_at(result, marks[-1])
    rows = []
    for case, runs in result.runs.groupby("case", sort=False):
        name = str(case)
        rank = ranks.get(name)
        cells = [name, "" if rank is None else str(rank)]
        for mark in marks:
            regret = runs[runs.samples == mark].regret.to_numpy()
            cost = result.greedy[name][mark].to_numpy()
            cells.append(_regret_cell(regret, two_way(cost, result.optimum[mark])))
        rows.append(cells)
    return rows


def _run_rows(runs: pd.DataFrame, marks: Sequence[int]) -> list[list[str]]:
    """Regret of each case's whole runs, with its interval over the runs, each on its own noise."""
    rows = []
    for case, case_runs in runs.groupby("case", sort=False):
        cells = [str(case)]
        for mark in marks:
            regret = case_runs[case_runs.samples == mark].life_regret.to_numpy()
            cells.append(_regret_cell(regret, median_over_runs(regret).interval))
        rows.append(cells)
    return rows


def _regret_cell(regret: Array, interval: Interval) -> str:
    """Median of the regrets (R,) of the runs in %, its interval, and the worst."""
    if not len(regret):
        return ""
    median = shown(float(np.median(regret)), interval, 100.0, 3)
    return f"{median} ({_shown_percent(regret.max())})"


def _ranks_at(result: OperationResult, mark: int) -> dict[str, int | None]:
    """Ranks of the cases by the median greedy J of their θ at a mark."""
    medians: dict[str, float] = {}
    trained_once = []
    for case, tables in result.greedy.items():
        if mark not in tables:
            continue
        medians[case] = float(tables[mark].mean(axis=1).median())
        if len(tables[mark]) < 2:
            trained_once.append(case)

    def is_worse(case: str, leader: str) -> bool:
        one, two = _pairs(result, case, leader, mark)
        # Without a training seed in common nothing is known.
        if not one.size:
            return False
        interval = paired_difference(one, two, result.optimum[mark])[1]
        return interval is not None and interval[0] > 0

    return shared_ranks(sorted(medians, key=medians.__getitem__), trained_once, is_worse)


def _effort_rows(
    end: pd.DataFrame, seconds: Mapping[str, float], samples_per_week: float
) -> list[list[str]]:
    """What each case's median run took.

    Args:
        end: rows of the runs at the last mark.
        seconds: processor time of each case.
        samples_per_week: of the plant.
    """
    by_case = end.groupby("case", sort=False)
    counts = by_case.size()
    rows = []
    for case, row in by_case.median(numeric_only=True).iterrows():
        violating = end[end.case == case].violating.dropna().to_numpy()
        violations = Estimate(np.nan)
        if len(violating):
            violations = median_over_runs(violating * samples_per_week)
        cells = [
            str(case),
            str(counts[case]),
            _whole(row.first_change),
            f"{100 * row.violating:.2f}",
            "" if np.isnan(violations.value) else shown(*violations, digits=3),
            f"{100 * row.dearest:.1f}",
            _whole(row.updates),
            _whole(row.model_samples),
            _whole(seconds.get(str(case), np.nan)),
        ]
        rows.append(cells)
    return rows


def _shift_rows(end: pd.DataFrame) -> list[list[str]]:
    """Shifts with a higher cost, of the cases that have moved θ for at least one."""
    rows = []
    for case, runs in end[end.dearer.notna()].groupby("case", sort=False):
        higher = f"{_whole(runs.dearer.median())} ({_whole(runs.dearer.max())})"
        excess = f"{100 * runs.excess.median():.2f} ({100 * runs.excess.max():.2f})"
        rows.append([str(case), str(len(runs)), higher, excess])
    return rows


def _difference_rows(
    result: OperationResult, marks: Sequence[int], against: Mapping[str, str | None]
) -> list[list[str]]:
    """Regret of a case less that of its counterpart, at each mark."""
    rows = []
    for case, other in against.items():
        costs = result.greedy.get(case, {})
        other_costs = result.greedy.get(str(other), {})
        if other is None or not costs or not other_costs or not result.optimum:
            continue
        cells = [f"{case} − {other}"]
        for mark in marks:
            one, two = _pairs(result, case, other, mark)
            value, interval, p = paired_difference(one, two, result.optimum[mark])
            said = shown(value, interval, 100, 3)
            cells.append(said if np.isnan(p) else f"{said}, p {p:.2f}")
        rows.append(cells)
    return rows


def _pairs(result: OperationResult, case: str, other: str, mark: int) -> tuple[Array, Array]:
    """Greedy J (R, S) of two cases at a mark, over the training seeds that both have."""
    one = result.greedy[case][mark]
    two = result.greedy[other][mark]
    common = one.index.intersection(two.index)
    # A controller has one row, for any seed.
    if len(common):
        one = one.loc[common]
        two = two.loc[common]
    pair = np.broadcast_arrays(one, two)
    return pair[0], pair[1]


def _shown_percent(share: float) -> str:
    return shown(float(share), None, 100.0, 3)


def _whole(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.0f}"
