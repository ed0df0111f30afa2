"""Regrets of runs in operation: of θ at the marks, and of a run's own samples until then."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from cosim.core.protocols import Array
from cosim.core.statistics import regrets, relative
from cosim.studies.ranks import NO_SEED, costs_more, paired_runs, shared_ranks

CostsByMark = dict[int, pd.DataFrame]
"""J by mark, a row for each training seed and a column for each seed of the noise, (R, S)."""
SAME_NOISE = ["training_seed", "samples"]
"""Columns that say a run's noise: that of its training seed, for as many samples."""


@dataclass(frozen=True)
class OperationResult:
    """Regrets of all runs in operation on one scenario.

    Attributes:
        greedy: J of the greedy policy by case and mark, (R, S).
        optimum: J* (S,) on the same noise by mark.
        runs: a row for each run and mark: `OPERATION_METRICS` with `dearest` as a regret and
            `excess` as a share of J*; `regret` of the greedy policy; `life_regret` of the whole
            run.
    """

    greedy: dict[str, CostsByMark]
    optimum: dict[int, Array]
    runs: pd.DataFrame

    def pairs(self, case: str, other: str, mark: int) -> tuple[Array, Array]:
        """Greedy J of two cases at a mark, over the training seeds that both have.

        Args:
            case: name of the case.
            other: name of the one that it is compared with.
            mark: samples of operation.

        Returns:
            J of both, (R, S) each.
        """
        cost = self.greedy[case][mark]
        other_cost = self.greedy[other][mark]
        return paired_runs(cost, other_cost)

    def ranks(self, mark: int) -> dict[str, int | None]:
        """Ranks of the cases by the median greedy J of their θ at a mark; None where unknown."""
        medians: dict[str, float] = {}
        trained_once = []
        for case, costs in self.greedy.items():
            if mark not in costs:
                continue
            # Of each run over the noise.
            mean_costs = costs[mark].mean(axis=1)
            medians[case] = float(mean_costs.median())
            if len(mean_costs) == 1:
                trained_once.append(case)

        def is_worse(case: str, leader: str) -> bool:
            cost, leader_cost = self.pairs(case, leader, mark)
            return costs_more(cost, leader_cost, self.optimum[mark])

        by_cost = sorted(medians, key=medians.__getitem__)
        return shared_ranks(by_cost, trained_once, is_worse)


def operation_result(
    runs: pd.DataFrame,
    greedy: pd.DataFrame,
    optimum: str,
) -> OperationResult:
    """Regrets of the runs on one scenario; without an optimum, against the best case at the time.

    Args:
        runs: rows of operation.csv.
        greedy: rows of greedy.csv.
        optimum: name of the case whose J is J*; another name if there is none.
    """
    costs = _greedy_costs(greedy)
    optimal_costs = costs.pop(optimum, None)
    optimal_greedy: dict[int, Array] = {}
    if optimal_costs is None:
        for mark in runs.samples.unique().tolist():
            optimal_greedy[mark] = _best_cost(costs.values(), mark)
        optimal_run_J = runs.groupby(SAME_NOISE).J.min()
    else:
        # The optimum is a controller, of which there is one run.
        for mark, cost in optimal_costs.items():
            optimal_greedy[mark] = cost.to_numpy()[0]
        runs_of_optimum = runs[runs.case == optimum]
        optimal_run_J = runs_of_optimum.set_index(SAME_NOISE).J

    # J* of each run's own noise, and J of its final θ, beside the run.
    run_key = ["case", *SAME_NOISE]
    greedy_J = greedy.groupby(run_key).J.mean()
    greedy_J = greedy_J.rename("greedy_J").reset_index()
    optimal_run_J = optimal_run_J.rename("optimal_J")
    rows = runs[runs.case != optimum]
    rows = rows.merge(optimal_run_J, on=SAME_NOISE, how="left")
    rows = rows.merge(greedy_J, on=run_key, how="left")

    # The greedy policies of a mark share its noise, the whole runs of a training seed theirs.
    optimal_greedy_J = {}
    for mark, cost in optimal_greedy.items():
        optimal_greedy_J[mark] = float(cost.mean())
    optimal_at_mark = rows.samples.map(optimal_greedy_J)
    rows["regret"] = regrets(rows.greedy_J.to_numpy(), optimal_at_mark.to_numpy())
    # Costs become regrets, and an excess a share of J*: their columns keep their names.
    optimal_J = rows.optimal_J.to_numpy()
    rows["life_regret"] = regrets(rows.J.to_numpy(), optimal_J)
    rows["dearest"] = regrets(rows.dearest.to_numpy(), optimal_J)
    rows["excess"] = relative(rows.excess.to_numpy(), optimal_J)
    return OperationResult(costs, optimal_greedy, rows)


def _greedy_costs(greedy: pd.DataFrame) -> dict[str, CostsByMark]:
    """J by case and mark."""
    costs: dict[str, CostsByMark] = {}
    # A controller has no training seed, and a table needs an index.
    seeds = greedy.training_seed.fillna(NO_SEED)
    numbered = greedy.assign(training_seed=seeds)
    for (case, mark), rows in numbered.groupby(["case", "samples"], sort=False):
        costs_at_marks = costs.setdefault(case, {})
        costs_at_marks[int(mark)] = rows.pivot(
            index="training_seed",
            columns="seed",
            values="J",
        )
    return costs


def _best_cost(cases: Iterable[CostsByMark], mark: int) -> Array:
    """Greedy J (S,) of the best case at a mark, its mean over the training seeds."""
    means = []
    for costs in cases:
        if mark not in costs:
            continue
        cost = costs[mark].to_numpy()
        means.append(cost.mean(axis=0))
    best: Array = min(means, key=np.mean)
    return best
