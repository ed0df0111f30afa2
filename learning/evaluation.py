"""Greedy evaluation of a training's θ on noise that it never sees, against the naive θ and J*."""

from __future__ import annotations

from functools import cached_property
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers import compile_functions
from controllers.optimum import yardstick
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.kpis import indicators_of
from cosim.plant.archive import SHIPPED
from cosim.protocols import Controller, Plant
from cosim.scenario import Scenario
from cosim.statistics import gap_closed, regret
from learning.training_run import TrainingRun, build_controller

Array = NDArray[np.float64]
HELD_OUT = 1_000_000
"""First of the held-out seeds; training seeds stay below."""
FIGURES = ("economic_cost", "mean_violation", "violating_share", "J", "failures")


class Judge:
    """Judges a run's θ by its greedy policy on the held-out seeds.

    `start` is a θ of the run's blocks. `optimum` is a controller whose J on the same seeds is J*,
    for the regret and the gap closed; without it they are NaN.
    """

    def __init__(
        self, run: TrainingRun, plant: Plant, start: Parameters, optimum: Controller | None
    ) -> None:
        self._run, self._plant, self._start, self._optimum = run, plant, start, optimum
        self._controller = build_controller(run.controller, run.scenario, start)

    def verdict(self, theta: Array) -> dict[str, Any]:
        """The greedy policy at θ (n_θ,): means of `FIGURES`, `regret`, `gap_closed`.

        `regret_interval` is its 95 % interval over the runs; `failures` is a sum; None is unknown.
        """
        costs = self._costs(theta)
        means: dict[str, Any] = {name: float(costs[name].mean()) for name in FIGURES}
        beyond = regret(costs["J"], self._optimal_cost)
        gap = gap_closed(costs["J"], self._naive_cost, self._optimal_cost).value
        known = isfinite(beyond.value)
        return means | {
            "failures": int(costs["failures"].sum()),
            "regret": beyond.value if known else None,
            "regret_interval": beyond.t,
            "gap_closed": gap if known else None,
        }

    @property
    def baselines(self) -> dict[str, float]:
        """J on the held-out runs of naive and, where it is known, optimal."""
        found = {"naive": float(self._naive_cost.mean())}
        if self._optimum is not None:
            found["optimal"] = float(self._optimal_cost.mean())
        return found

    @cached_property
    def start_J(self) -> float:
        """J on the held-out runs of θ where the run starts."""
        return float(self._costs(self._start.theta)["J"].mean())

    @property
    def limit(self) -> float:
        """Greedy J above which a run has diverged."""
        # A cost may be negative, a profit say: the margin counts in its magnitude.
        worst = max(float(self._naive_cost.mean()), self.start_J)
        return worst + (self._run.divergence - 1) * abs(worst)

    def _costs(self, policy: Array | Controller) -> dict[str, Array]:
        """Indicators on the held-out seeds of the greedy policy at θ, or of a controller."""
        if isinstance(policy, np.ndarray):
            self._controller.theta = policy
            policy = self._controller
        seeds = range(HELD_OUT, HELD_OUT + self._run.evaluation_seeds)
        compile_functions(policy, self._run.evaluation_steps * len(seeds))
        return indicators_of(self._plant, policy, seeds, self._run.evaluation_steps)

    @cached_property
    def _naive_cost(self) -> Array:
        run = self._run
        naive = Parameters.naive(Problem.from_scenario(run.scenario))
        return self._costs(build_controller(run.controller, run.scenario, naive))["J"]

    @cached_property
    def _optimal_cost(self) -> Array:
        if self._optimum is None:
            return np.full(self._run.evaluation_seeds, np.nan)
        return self._costs(self._optimum)["J"]


def stored_optimum(scenario: Scenario) -> str | None:
    """`optimal` where it is the scenario's yardstick and can be had without solving anything.

    A foreign FMU may be another plant than the controller's model, whose optimum it is, unless the
    scenario names the plant's own model.
    """
    if scenario.plant.fmu not in SHIPPED and scenario.plant.model is None:
        return None
    return None if yardstick(scenario) is None else "optimal"
