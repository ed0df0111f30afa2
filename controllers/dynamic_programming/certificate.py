"""What must agree before a mean cost is called J*: solution, refinement, simulation, search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.bellman import Elementwise, PlantProblem
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.policy_iteration import (
    Certificate,
    Figure,
    Optimum,
    Progress,
    Settings,
    refine,
)
from controllers.model import discretise, economic_cost

Array = NDArray[np.float64]


def simulate_policy(
    plant: PlantProblem,
    optimum: Optimum,
    *,
    paths: int = 2000,
    steps: int = 5000,
    burn_in: int = 300,
    seed: int = 0,
) -> tuple[float, float]:
    """Mean cost per sample of a solution's policy on the plant's model, and half its 95 % interval.

    The policy is interpolated as the controller does it. Each path starts in a state drawn from the
    solution's stationary distribution, and its first `burn_in` samples are left out. The interval
    is that of the mean of independent paths.
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
            violations = problem.penalty.violation(np.stack(x, axis=1)).T
            for v, linear, quadratic in zip(
                violations, problem.penalty_linear, problem.penalty_quadratic, strict=True
            ):
                total += (linear + quadratic * v) * v
        x = [np.broadcast_to(entry, paths) for entry in step(x, u, d, plant.parameters)]
    means = total / steps
    half_width = 1.96 * means.std(ddof=1) / np.sqrt(paths)
    return float(means.mean()), float(half_width)


STABLE = 1e-3
_MOST_GRIDS = 3


@dataclass(frozen=True)
class Row:
    """A solution of the study; `change` is that of J* against what it refines, relative."""

    name: str
    optimum: Optimum
    change: float | None = None

    @property
    def sizes(self) -> tuple[tuple[int, ...], ...]:
        """Grid points a state, quadrature nodes and those of the penalty a disturbance."""
        accuracy = self.optimum.accuracy
        return self.optimum.grid.shape, accuracy.nodes, accuracy.penalty_nodes

    def to_dict(self) -> dict[str, Any]:
        """The row as JSON has it."""
        found = self.optimum
        return {
            "name": self.name,
            "J": found.gain,
            "lower": found.lower,
            "upper": found.upper,
            "states": found.grid.shape,
            "accuracy": asdict(found.accuracy),
            "change": self.change,
        }

    @property
    def stable(self) -> bool:
        """Whether refining changed J* by no more than 0.1 %."""
        return self.change is None or self.change <= STABLE


def study(
    plant: PlantProblem,
    settings: Settings,
    optimum: Optimum,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> list[Row]:
    """Refine a solution of `settings` until J* is stable to 0.1 %, then its quadrature once.

    The grid is halved at least once and at most three times; the last row has the finer
    quadrature and integrator on the first grid. `stable` of the last two rows is the verdict.
    """
    rows = [Row("solution", optimum)]
    for level in range(settings.level + 1, settings.level + 1 + _MOST_GRIDS):
        before = rows[-1].optimum
        after = refine(plant, settings, before, level=level, progress=progress)
        rows.append(Row("grid twice as fine", after, _change(before, after)))
        if rows[-1].stable:
            break
    finer = optimum.accuracy.finer()
    after = refine(plant, settings, optimum, accuracy=finer, progress=progress)
    return [*rows, Row("quadrature finer", after, _change(optimum, after))]


def certify(
    plant: PlantProblem, rows: Sequence[Row], *, paths: int = 2000, steps: int = 5000
) -> Optimum:
    """The first refinement of a study, with its certificate.

    It is what is kept, since it is nearer to J* than the solution that the study began with. The
    simulation is that of its policy, by `simulate_policy`.
    """
    solution, refinement = rows[0].optimum, rows[1].optimum
    mean, half_width = simulate_policy(plant, refinement, paths=paths, steps=steps)
    figures = (
        Figure("solution", solution.gain, solution.lower, solution.upper),
        Figure("refinement", refinement.gain, refinement.lower, refinement.upper),
        Figure("simulation", mean, mean - half_width, mean + half_width),
    )
    return replace(refinement, certificate=Certificate(figures))


def _change(before: Optimum, after: Optimum) -> float:
    return abs(after.gain - before.gain) / abs(after.gain)
