"""Greedy evaluation of θ on noise that training never sees, against the naive one and J*."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from controllers.problem import Problem
from cosim.protocols import Controller, Plant
from cosim.simulation import simulate
from cosim.statistics import Estimate, gap_closed, regret
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
            simulate(self.plant, controller, self.steps, seed, residuals=False).summary()
            for seed in self.seeds
        ]
        names = ("economic_cost", "mean_violation", "violating_share", "J", "failures")
        return {name: np.array([float(s[name]) for s in summaries]) for name in names}

    def means(self, controller: Controller) -> dict[str, float]:
        """Mean of each figure over the seeds; `failures` is their sum."""
        return means(self.costs(controller))


@dataclass(frozen=True)
class Verdict:
    """A greedy policy on the held-out runs: means of its figures, regret and gap closed.

    `regret` has its 95 % interval over the runs; it and `gap_closed` are NaN where J* is not known.
    """

    means: dict[str, float]
    regret: Estimate
    gap_closed: float

    def row(self) -> dict[str, float]:
        """The columns of a training's log."""
        row = {f"greedy_{name}": value for name, value in self.means.items()}
        return row | {"regret": self.regret.value, "gap_closed": self.gap_closed}

    def summary(self) -> dict[str, Any]:
        """The keys of a training's summary; None for what is not known."""
        known = isfinite(self.regret.value)
        relative = {
            "regret": self.regret.value if known else None,
            "regret_interval": self.regret.t,
            "gap_closed": self.gap_closed if known else None,
        }
        return {**self.means, **relative}


class Judge:
    """Judges a run's θ by its greedy policy on the held-out seeds.

    `start` is a θ of the run's blocks. `optimum` is a controller whose J on the same seeds is J*,
    for the regret and the gap closed; without it they are NaN.
    """

    def __init__(
        self, run: TrainingRun, plant: Plant, start: Parameters, optimum: Controller | None
    ) -> None:
        self._run, self._start, self._optimum = run, start, optimum
        self._problem = Problem.from_scenario(run.scenario)
        self._controller = self._build(start)
        self._evaluation = HeldOutRuns(plant, held_out(run.evaluation_seeds), run.evaluation_steps)

    def _build(self, parameters: Parameters) -> LearnableController:
        run = self._run
        return build_controller(run.controller, run.scenario, parameters)

    def controller(self, theta: NDArray[np.float64]) -> Controller:
        """The greedy controller at θ (n_θ,); the same one, moved, at every call."""
        self._controller.theta = theta
        return self._controller

    def verdict(self, theta: NDArray[np.float64]) -> Verdict:
        """The greedy policy at θ (n_θ,), judged."""
        costs = self._evaluation.costs(self.controller(theta))
        return Verdict(
            means(costs),
            regret(costs["J"], self._optimal_cost),
            gap_closed(costs["J"], self._naive_cost, self._optimal_cost).value,
        )

    @property
    def baselines(self) -> dict[str, float]:
        """J on the held-out runs of naive and, where it is known, optimal."""
        found = {"naive": float(self._naive_cost.mean())}
        if self._optimum is not None:
            found["optimal"] = float(self._optimal_cost.mean())
        return found

    @property
    def start_J(self) -> float:
        """J on the held-out runs of θ where the run starts."""
        return float(self._start_cost.mean())

    @property
    def limit(self) -> float:
        """Greedy J above which a run has diverged."""
        # A cost may be negative, a profit say: the margin counts in its magnitude.
        worst = max(float(self._naive_cost.mean()), float(self._start_cost.mean()))
        return worst + (self._run.divergence - 1) * abs(worst)

    @cached_property
    def _naive_cost(self) -> NDArray[np.float64]:
        naive = self._build(Parameters.naive(self._problem))
        return self._evaluation.costs(naive)["J"]

    @cached_property
    def _start_cost(self) -> NDArray[np.float64]:
        return self._evaluation.costs(self.controller(self._start.theta))["J"]

    @cached_property
    def _optimal_cost(self) -> NDArray[np.float64]:
        if self._optimum is None:
            return np.full(len(self._evaluation.seeds), np.nan)
        return self._evaluation.costs(self._optimum)["J"]


def means(costs: dict[str, NDArray[np.float64]]) -> dict[str, float]:
    """Mean of each figure over the seeds; `failures` is their sum."""
    figures: dict[str, Any] = {name: float(values.mean()) for name, values in costs.items()}
    figures["failures"] = int(costs["failures"].sum())
    return figures


def held_out(count: int) -> tuple[int, ...]:
    """The first `count` held-out seeds."""
    return tuple(HELD_OUT + k for k in range(count))
