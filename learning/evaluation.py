"""Greedy evaluation of θ on noise that training never sees, against the naive one and J*."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from controllers.problem import Problem
from cosim.protocols import Controller, Plant
from cosim.simulation import simulate
from learning.protocols import LearnableController
from learning.starting_point import build_controller
from learning.training_run import TrainingRun

HELD_OUT = 1_000_000
"""First of the held-out seeds; training seeds stay below."""


@dataclass(frozen=True)
class HeldOutRuns:
    """Runs of `steps` samples of `plant` from the initial state, one for each of the `seeds`."""

    plant: Plant
    seeds: tuple[int, ...]
    steps: int

    def costs(self, controller: Controller) -> dict[str, NDArray[np.float64]]:
        """Summary figures of each run, (seeds,): J, economic_cost, mean_violation and so on."""
        summaries = [
            simulate(self.plant, controller, self.steps, seed).summary() for seed in self.seeds
        ]
        names = ("economic_cost", "mean_violation", "violating_share", "J", "failures")
        return {name: np.array([float(s[name]) for s in summaries]) for name in names}

    def means(self, controller: Controller) -> dict[str, float]:
        """Mean of each figure over the seeds; `failures` is their sum."""
        costs = self.costs(controller)
        figures: dict[str, Any] = {name: float(values.mean()) for name, values in costs.items()}
        figures["failures"] = int(costs["failures"].sum())
        return figures


class Judge:
    """Judges a run's θ by its greedy policy on the held-out seeds.

    `start` is a θ of the run's blocks. `optimum` is a controller whose J on the same seeds is J*,
    for the gap closed; without it the gap is NaN.
    """

    def __init__(
        self, run: TrainingRun, plant: Plant, start: Parameters, optimum: Controller | None
    ) -> None:
        self._run, self._optimum = run, optimum
        self._problem = Problem.from_scenario(cast("Any", run.scenario))
        self._controller = self._build(start)
        self._evaluation = HeldOutRuns(plant, held_out(run.evaluation_seeds), run.evaluation_steps)

    def _build(self, parameters: Parameters) -> LearnableController:
        run = self._run
        return build_controller(run.controller, run.scenario, self._problem, parameters)

    def controller(self, theta: NDArray[np.float64]) -> Controller:
        """The greedy controller at θ (n_θ,); the same one, moved, at every call."""
        self._controller.theta = theta
        return cast("Controller", self._controller)

    def figures(self, theta: NDArray[np.float64]) -> dict[str, float]:
        """Means of the indicators at θ (n_θ,)."""
        return self._evaluation.means(self.controller(theta))

    def gap_closed(self, cost: float) -> float:
        """Share of the gap between the naive controller and the optimum, NaN without optimum."""
        return gap_closed(cost, self._naive_cost, self._optimal_cost)

    @property
    def limit(self) -> float:
        """Greedy J above which a run has diverged."""
        # A cost may be negative, a profit say: the margin counts in its magnitude.
        return self._naive_cost + (self._run.divergence - 1) * abs(self._naive_cost)

    @cached_property
    def _naive_cost(self) -> float:
        naive = self._build(Parameters.naive(self._problem))
        return self._evaluation.means(cast("Controller", naive))["J"]

    @cached_property
    def _optimal_cost(self) -> float:
        if self._optimum is None:
            return float("nan")
        return self._evaluation.means(self._optimum)["J"]


def held_out(count: int) -> tuple[int, ...]:
    """The first `count` held-out seeds."""
    return tuple(HELD_OUT + k for k in range(count))


def gap_closed(cost: float, naive: float, optimum: float) -> float:
    """(J_naive − J) / (J_naive − J*)."""
    return (naive - cost) / (naive - optimum)
