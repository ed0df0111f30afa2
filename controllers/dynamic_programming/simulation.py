"""The mean cost of a tabulated policy by simulation of its plant: no quadrature, no bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.elementwise import Elementwise
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.plant import PlantProblem
from controllers.dynamic_programming.solution import Optimum
from controllers.model import discretise, economic_cost

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimulatedCost:
    """Mean cost per sample over independent paths, with the half width of its 95 % interval."""

    mean: float
    half_width: float
    paths: int
    steps: int


def simulate_policy(
    plant: PlantProblem,
    optimum: Optimum,
    *,
    paths: int = 2000,
    steps: int = 5000,
    burn_in: int = 300,
    seed: int = 0,
) -> SimulatedCost:
    """Run the policy of a solution on the plant's model, interpolated as the controller does it.

    Each path starts in a state drawn from the solution's stationary distribution, and its first
    `burn_in` samples are left out. The interval is that of the mean of independent paths.
    """
    generator = np.random.default_rng(seed)
    problem = plant.problem
    step = Elementwise(discretise(problem.model, problem.sampling_time, optimum.accuracy.substeps))
    cost = Elementwise(economic_cost(problem.model))
    table = Grid(optimum.grid.axes)
    policy = [table.interpolant(column) for column in optimum.actions.T]
    share = optimum.distribution / optimum.distribution.sum()
    x = list(table.points[generator.choice(table.size, paths, p=share)].T)
    total = np.zeros(paths)
    for k in range(burn_in + steps):
        u = [entry(x) for entry in policy]
        d = list(plant.law.draw(generator, paths).T)
        if k >= burn_in:
            total += cost(x, u, d, plant.parameters)[0]
            for i, entry in enumerate(x):
                violation = np.maximum(
                    np.maximum(problem.state_lower[i] - entry, entry - problem.state_upper[i]), 0.0
                )
                total += (
                    problem.penalty_linear[i] + problem.penalty_quadratic[i] * violation
                ) * violation
        x = [np.broadcast_to(entry, paths) for entry in step(x, u, d, plant.parameters)]
    means = total / steps
    half_width = 1.96 * means.std(ddof=1) / np.sqrt(paths)
    return SimulatedCost(float(means.mean()), float(half_width), paths, steps)
