"""Greedy evaluation of a training's θ on held-out noise."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite, nan
from typing import Any

import numpy as np

from controllers import compile_functions
from controllers.estimator import measured
from controllers.factories import nmpc
from controllers.functions import switch
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.protocols import Array, Controller, Plant
from cosim.core.simulation import indicators_of
from cosim.core.statistics import gap_closed, regret
from cosim.core.training_options import HELD_OUT
from learning.log import METRICS
from learning.training_run import TrainingRun
from learning.verdict import cost_difference

KnownCosts = dict[tuple[Any, ...], dict[str, Array]]
"""Indicators on held-out noise, (K,) each, by what they depend on."""


class Evaluator:
    """Evaluates a run's θ by its greedy policy on the held-out seeds.

    Without a seed no plant steps, no figure is known, and no limit is set.

    Args:
        run: says how many seeds and samples.
        plant: of its scenario.
        start: θ where the run starts.
        optimum: its J on the same seeds is J*; None: unknown.
        known: what earlier runs of this process have found of naive and start, and where this one
            puts it; runs of a study often start alike.
        progress: called each second or so with the plant samples so far.

    Attributes:
        start: what `evaluate` says of the start.
        baselines: J of naive and, where it is known, optimal.
        limit: greedy J above which a run has diverged.
        n_baselines: number of controllers evaluated before the first sample: naive, optimum, start.
        samples: plant samples taken so far.
    """

    def __init__(
        self,
        run: TrainingRun,
        plant: Plant,
        start: Parameters,
        optimum: Controller | None,
        known: KnownCosts | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        self._run = run
        self._plant = plant
        self._known = {} if known is None else known
        self._progress = progress
        self._controller: RtiNmpc | None = None
        self.samples = 0
        self.n_baselines = 0
        self.baselines: dict[str, float] = {}
        if not run.evaluation_seeds:
            self.start = _nothing_known()
            self.limit = inf
            return
        # All that a training is compared with meets the same noise.
        naive = Parameters.naive(Problem.from_scenario(run.scenario))
        naive_costs = self._costs_at(naive)
        self.baselines["naive"] = float(naive_costs["J"].mean())
        self.n_baselines = 1
        self._optimal_costs = np.full(run.evaluation_seeds, np.nan)
        if optimum is not None:
            self._optimal_costs = self._costs(optimum)["J"]
            self.baselines["optimal"] = float(self._optimal_costs.mean())
            self.n_baselines += 1
        start_costs = self._costs_at(start)
        # Of one θ there is one evaluation.
        if self._key(start) != self._key(naive):
            self.n_baselines += 1
        self._start_costs = start_costs["J"]
        self.start = self._metrics(start_costs)
        self._start = start
        self._theta = start.theta
        self._evaluation = self.start

        # A cost may be negative (a profit): the margin is a share of its magnitude.
        worst = max(self.baselines["naive"], self.start["J"])
        excess = run.divergence - 1
        margin = excess * abs(worst)
        self.limit = worst + margin

    def evaluate(self, theta: Array) -> dict[str, Any]:
        """The greedy policy at θ (n_θ,).

        Returns:
            Means of `METRICS`, `failures` a sum; `difference` of J from the start's and its
            `difference_interval`; `regret`, its `regret_interval`, and `gap_closed`, the share of
            the start's regret that is gone, None where unknown. Intervals are of 95 %, over the
            seeds. Without a seed all numbers are NaN.
        """
        if not self._run.evaluation_seeds:
            return self.start
        # A training ends with the θ of its last row, and a rule may leave θ as it is.
        if not np.array_equal(theta, self._theta):
            costs = self._costs(self._law_at(theta))
            self._evaluation = self._metrics(costs)
            self._theta = theta.copy()
        return self._evaluation

    def _metrics(self, costs: dict[str, Array]) -> dict[str, Any]:
        """Result of `evaluate` from the indicators of the seeds, (K,) each."""
        J = costs["J"]
        excess = regret(J, self._optimal_costs)
        # A start that is the optimum leaves no gap.
        gap = gap_closed(J, self._start_costs, self._optimal_costs)
        difference = cost_difference(J, self._start_costs)
        means: dict[str, Any] = {}
        for name in METRICS:
            means[name] = float(costs[name].mean())
        # Failures are rare: how many there were says more than their mean.
        means["failures"] = int(costs["failures"].sum())
        return {
            **means,
            "difference": difference.value,
            "difference_interval": difference.interval,
            "regret": number_if_known(excess.value),
            "regret_interval": excess.interval,
            "gap_closed": number_if_known(gap.value),
        }

    def _law_at(self, theta: Array) -> Controller:
        """The run's controller at θ (n_θ,), behind the estimator if there is one."""
        if self._controller is None:
            self._controller = nmpc(self._run.scenario, self._start, self._run.controller)
            self._law = measured(self._run.scenario, self._controller)
        self._controller.theta = theta
        return self._law

    def _key(self, parameters: Parameters) -> tuple[Any, ...]:
        """Inputs of the costs at a θ."""
        run = self._run
        return (
            run.scenario.hash,
            run.controller,
            run.evaluation_seeds,
            run.evaluation_steps,
            # Compiled and interpreted controllers differ in the last digits.
            switch(),
            parameters.blocks.labels,
            parameters.theta.tobytes(),
        )

    def _costs_at(self, parameters: Parameters) -> dict[str, Array]:
        """Indicators at a θ, (K,) each; those that are known are not measured again."""
        key = self._key(parameters)
        if key not in self._known:
            controller = nmpc(self._run.scenario, parameters, self._run.controller)
            self._known[key] = self._costs(measured(self._run.scenario, controller))
        return self._known[key]

    def _costs(self, policy: Controller) -> dict[str, Array]:
        """Indicators of a controller on the held-out seeds, (K,) each."""
        run = self._run
        seeds = range(HELD_OUT, HELD_OUT + run.evaluation_seeds)
        # All runs together say whether compiling pays.
        n_samples = run.evaluation_steps * run.evaluation_seeds
        compile_functions(policy, n_samples)
        costs = indicators_of(
            self._plant,
            policy,
            seeds,
            run.evaluation_steps,
            progress=self._show,
        )
        self.samples += n_samples
        return costs

    def _show(self, samples: int) -> None:
        """Report the samples of the present evaluation, which are not counted yet."""
        if self._progress is not None:
            self._progress(self.samples + samples)


def number_if_known(value: float) -> float | None:
    """The number for a JSON document; None where it is NaN or infinite, so not known."""
    return value if isfinite(value) else None


def _nothing_known() -> dict[str, Any]:
    """Result of `evaluate` without a held-out run."""
    names = (*METRICS, "failures", "difference")
    numbers: dict[str, Any] = dict.fromkeys(names, nan)
    return {
        **numbers,
        "difference_interval": None,
        "regret": None,
        "regret_interval": None,
        "gap_closed": None,
    }
