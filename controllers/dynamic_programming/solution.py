"""The stochastic control problem solved from a coarse grid to a fine one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.axes import finer_grid, first_grid
from controllers.dynamic_programming.bellman import Accuracy, BellmanOperator
from controllers.dynamic_programming.certificate import Certificate
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.howard import Iterate, begin, iterate_policy
from controllers.dynamic_programming.plant import PlantProblem
from controllers.dynamic_programming.settings import Settings
from controllers.errors import OptimumError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Progress:
    """Where the solver is: grid level, round on it, size of the grid, gain and its bounds."""

    level: int
    round: int
    states: int
    gain: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Optimum:
    """A solved problem: the policy and smooth value on the grid, and what certifies them.

    `actions` (G, m), `W` (G,) with V = penalty + W; `gain` J*, the mean cost per sample;
    `lower` and `upper` as in `Iterate`; `distribution` (G,) the stationary one; `certificate` what
    was compared with the gain, if anything.
    """

    grid: Grid
    actions: Array
    W: Array
    gain: float
    lower: float
    upper: float
    distribution: Array
    discount: float
    accuracy: Accuracy
    certificate: Certificate | None = None

    @property
    def edge_mass(self) -> float:
        """Share of samples that the closed loop spends on the edge of the grid's box."""
        return float(self.distribution[self.grid.boundary].sum())


def solve(
    plant: PlantProblem,
    settings: Settings | None = None,
    *,
    workers: int = 2,
    progress: Callable[[Progress], None] | None = None,
) -> Optimum:
    """Solve for the optimal policy of the stochastic plant by Howard's policy iteration.

    Raises OptimumError where the bounds do not close to 1 % of the gain, or where the closed loop
    leaves the grid's box in more than one of 10⁴ samples.
    """
    problem, settings = plant.problem, settings or Settings()
    accuracy = settings.accuracy(plant)
    discount = 1.0 if settings.criterion == "average" else problem.discount
    draft, operator = (
        BellmanOperator(plant, how, discount=discount, workers=workers)
        for how in (accuracy.draft(), accuracy)
    )
    grid = first_grid(problem, draft, settings)
    actions = np.tile(problem.reference_action, (grid.size, 1))
    iterate = begin(draft, grid, actions)
    report = _Reporter(progress)
    # Linear interpolation is monotone, so that it finds its way from anywhere, and it smears the
    # closed loop over its cells, so that the support is known only once these are fine.
    for level, smooth in ((1, False), *((k + 1, True) for k in range(settings.level))):
        if settings.level:
            iterate = _approach(draft, iterate, settings, report)
            grid = _finer(draft, iterate, settings, level, smooth=smooth)
            iterate = _transfer(draft, iterate, grid)
            report.level = level
    iterate = _scan(draft, _approach(draft, iterate, settings, report), report)
    return _optimum(_converge(operator, iterate, settings, report), operator, accuracy)


def refine(
    plant: PlantProblem,
    settings: Settings,
    optimum: Optimum,
    *,
    level: int | None = None,
    accuracy: Accuracy | None = None,
    workers: int = 2,
    progress: Callable[[Progress], None] | None = None,
) -> Optimum:
    """Solve again from a solution, on the grid of another level or with another accuracy.

    Raises OptimumError as `solve` does.
    """
    accuracy = accuracy or optimum.accuracy
    operator = BellmanOperator(plant, accuracy, discount=optimum.discount, workers=workers)
    start = begin(operator, optimum.grid, optimum.actions)
    report = _Reporter(progress)
    report.level = settings.level if level is None else level
    grid = optimum.grid if level is None else _finer(operator, start, settings, level)
    iterate = _converge(operator, _transfer(operator, start, grid), settings, report)
    return _optimum(iterate, operator, accuracy)


def _optimum(iterate: Iterate, operator: BellmanOperator, accuracy: Accuracy) -> Optimum:
    optimum = Optimum(
        iterate.grid,
        iterate.actions,
        iterate.W,
        iterate.gain,
        min(iterate.lower, iterate.gain) if operator.discount == 1.0 else iterate.lower,
        max(iterate.upper, iterate.gain) if operator.discount == 1.0 else iterate.upper,
        np.maximum(iterate.distribution, 0.0),
        operator.discount,
        accuracy,
    )
    if iterate.spread > 0.01 * abs(iterate.gain):
        raise OptimumError(
            f"policy iteration: the bounds of the gain, {iterate.lower:.6g} and "
            f"{iterate.upper:.6g}, are more than 1 % apart; allow more rounds or another grid"
        )
    if optimum.edge_mass > 1e-4:
        raise OptimumError(
            f"the optimal closed loop is on the edge of the grid's box in "
            f"{100 * optimum.edge_mass:.3g} % of the samples; widen the state bounds"
        )
    return optimum


class _Reporter:
    """Passes iterates on to the caller's progress function."""

    def __init__(self, progress: Callable[[Progress], None] | None) -> None:
        self.level = 0
        self._progress = progress

    def __call__(self, iterate: Iterate, k: int) -> None:
        if self._progress is not None:
            size = iterate.grid.size
            self._progress(
                Progress(self.level, k, size, iterate.gain, iterate.lower, iterate.upper)
            )


def _approach(
    operator: BellmanOperator, iterate: Iterate, settings: Settings, report: _Reporter
) -> Iterate:
    """Iterate until the gain falls no more: a start for the next grid needs no bounds."""
    return iterate_policy(
        operator,
        iterate,
        rounds=settings.rounds,
        scan_points=5,
        enough=lambda before, after: before.gain - after.gain <= 1e-4 * abs(after.gain),
        report=report,
    )


def _scan(operator: BellmanOperator, iterate: Iterate, report: _Reporter) -> Iterate:
    """One round that looks for better actions in the whole action box."""
    return iterate_policy(
        operator, iterate, rounds=1, scan_points=9, enough=lambda *_: True, report=report
    )


def _converge(
    operator: BellmanOperator, iterate: Iterate, settings: Settings, report: _Reporter
) -> Iterate:
    """Iterate until the bounds meet."""
    return iterate_policy(
        operator,
        iterate,
        rounds=settings.rounds,
        scan_points=3,
        enough=lambda _, after: after.spread <= settings.tolerance * abs(after.gain),
        report=report,
    )


def _finer(
    operator: BellmanOperator,
    found: Iterate,
    settings: Settings,
    level: int,
    *,
    smooth: bool = True,
) -> Grid:
    return finer_grid(
        operator,
        found.grid,
        found.actions,
        found.distribution,
        settings,
        level,
        smooth=smooth,
    )


def _transfer(operator: BellmanOperator, iterate: Iterate, grid: Grid) -> Iterate:
    actions = iterate.grid.resample(iterate.actions, grid)
    start = begin(operator, grid, actions)
    return replace(start, step=0.1 * start.step)
