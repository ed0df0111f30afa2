"""The stochastic control problem solved from a coarse grid to a fine one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.axes import graded_axis, support
from controllers.dynamic_programming.bellman import Accuracy, BellmanOperator
from controllers.dynamic_programming.elementwise import Elementwise
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.howard import Iterate, begin, iterate_policy
from controllers.dynamic_programming.quadrature import DisturbanceLaw
from controllers.errors import OptimumError
from controllers.model import discretise
from controllers.problem import Problem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """How the problem is solved.

    `criterion`: mean cost per sample, or cost discounted by the problem's γ. `level` 0 is a first
    grid over all states, each further level resolves the closed loop's support with `cells`·2^level
    cells a state. `nodes` and `penalty_nodes` per disturbance, the influential ones first;
    empty: 7 and 20 for the first two, 2 and 4, 2 for the next. `integration_tolerance` on
    the sampled model, relative; `tolerance` on the distance of the gain's bounds, relative.
    """

    criterion: Literal["average", "discounted"] = "average"
    level: int = 1
    cells: int = 12
    growth: float = 1.35
    tail: float = 1e-7
    nodes: tuple[int, ...] = ()
    penalty_nodes: tuple[int, ...] = ()
    integration_tolerance: float = 1e-7
    tolerance: float = 1e-4
    rounds: int = 40

    def accuracy(self, problem: Problem, law: DisturbanceLaw, parameters: Array) -> Accuracy:
        """Integrator and quadrature for a problem."""
        count = len(law.nominal)
        return Accuracy(
            accurate_substeps(problem, law, parameters, self.integration_tolerance),
            self.nodes or (7, 7, *(2,) * count)[:count],
            self.penalty_nodes or (20, 20, 4, *(2,) * count)[:count],
        )


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
    `lower` and `upper` as in `Iterate`; `distribution` (G,) the stationary one.
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

    @property
    def edge_mass(self) -> float:
        """Share of samples that the closed loop spends on the edge of the grid's box."""
        return float(self.distribution[self.grid.boundary].sum())


def solve(
    problem: Problem,
    law: DisturbanceLaw,
    settings: Settings | None = None,
    *,
    parameters: Array | None = None,
    workers: int = 2,
    progress: Callable[[Progress], None] | None = None,
) -> Optimum:
    """Solve for the optimal policy of the stochastic plant by Howard's policy iteration.

    `parameters` (n_p,) are the plant's physical ones (default: the model's nominal). Raises
    OptimumError where the bounds do not close to 1 % of the gain, or where the closed loop leaves
    the grid's box in more than one of 10⁴ samples.
    """
    settings = settings or Settings()
    if len(law.nominal) != len(problem.model.disturbances):
        raise OptimumError(
            f"the law has {len(law.nominal)} disturbances, model '{problem.model.name}' "
            f"{len(problem.model.disturbances)}"
        )
    parameters = problem.model.nominal_parameters if parameters is None else parameters
    accuracy = settings.accuracy(problem, law, parameters)
    discount = 1.0 if settings.criterion == "average" else problem.discount
    draft, operator = (
        BellmanOperator(problem, law, parameters, how, discount=discount, workers=workers)
        for how in (accuracy.draft(), accuracy)
    )
    grid = first_grid(problem, draft, settings)
    actions = np.tile(problem.reference_action, (grid.size, 1))
    iterate = begin(draft, grid, actions)
    report = _Reporter(progress)
    for level in range(settings.level):
        iterate = _approach(operator if level else draft, iterate, settings, report)
        grid = finer_grid(problem, law, iterate, settings, level + 1)
        iterate = _transfer(operator, iterate, grid)
        report.level = level + 1
    iterate = _converge(operator, iterate, settings, report)
    optimum = Optimum(
        iterate.grid,
        iterate.actions,
        iterate.W,
        iterate.gain,
        iterate.lower,
        iterate.upper,
        np.maximum(iterate.distribution, 0.0),
        discount,
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


def _converge(
    operator: BellmanOperator, iterate: Iterate, settings: Settings, report: _Reporter
) -> Iterate:
    """Iterate until the bounds meet, and meet again with a scan of the whole action box."""

    def close(_: Iterate, after: Iterate) -> bool:
        return after.spread <= settings.tolerance * abs(after.gain)

    for scan_points in (3, 9):
        iterate = iterate_policy(
            operator,
            iterate,
            rounds=settings.rounds,
            scan_points=scan_points,
            enough=close,
            report=report,
        )
    return iterate


def _transfer(operator: BellmanOperator, iterate: Iterate, grid: Grid) -> Iterate:
    actions = iterate.grid.resample(iterate.actions, grid)
    start = begin(operator, grid, actions)
    return replace(start, step=0.1 * start.step)


def first_grid(problem: Problem, operator: BellmanOperator, settings: Settings) -> Grid:
    """Grid over all states within the bounds and a tenth beyond, graded from the reference.

    The cells at the reference are half a standard deviation of one sample's disturbance wide.
    """
    deviation = operator.deviation(problem.reference_state, problem.reference_action)
    axes = []
    for low, high, centre, sigma in zip(
        problem.state_lower, problem.state_upper, problem.reference_state, deviation, strict=True
    ):
        span = high - low
        spacing = max(0.5 * sigma, 1e-3 * span)
        axes.append(
            graded_axis(
                low - 0.1 * span,
                high + 0.1 * span,
                centre - spacing,
                centre + spacing,
                spacing,
                settings.growth,
            )
        )
    return Grid(tuple(axes))


def finer_grid(
    problem: Problem, law: DisturbanceLaw, iterate: Iterate, settings: Settings, level: int
) -> Grid:
    """Grid that resolves the support of the closed loop with cells·2^level cells a state.

    It reaches as far again beyond the support on either side, and at least a twentieth of the
    bounds' span: farther states are so rare that the policy at the box's edge serves them.
    Without disturbance the support is a point, which says nothing of that, and the box stays.
    """
    share = 1.0 if law.deterministic else 0.05
    margin = share * (problem.state_upper - problem.state_lower)
    mass = np.maximum(iterate.distribution, 0.0).reshape(iterate.grid.shape)
    axes = []
    for i, axis in enumerate(iterate.grid.axes):
        others = tuple(j for j in range(mass.ndim) if j != i)
        first, last = support(axis, mass.sum(axis=others), settings.tail)
        width = last - first
        spacing = width / (settings.cells * 2**level)
        beyond = max(width, margin[i])
        low = max(axis[0], min(first, problem.reference_state[i]) - beyond)
        high = min(axis[-1], max(last, problem.reference_state[i]) + beyond)
        axes.append(graded_axis(low, high, first, last, spacing, settings.growth))
    return Grid(tuple(axes))


def accurate_substeps(
    problem: Problem, law: DisturbanceLaw, parameters: Array, tolerance: float
) -> int:
    """Least power of two of RK4 substeps whose doubling moves no next state by more than allowed.

    Allowed is `tolerance`·(1 + |x|), tried at 2000 points: states within the first quarter of the
    bounds' box around the reference, actions in their box, disturbances of the law. Raises
    OptimumError where 256 substeps do not do.
    """
    generator = np.random.default_rng(0)
    reach = 0.25 * (problem.state_upper - problem.state_lower)
    x = generator.uniform(
        np.maximum(problem.state_lower, problem.reference_state - reach),
        np.minimum(problem.state_upper, problem.reference_state + reach),
        (2000, problem.n_states),
    )
    u = generator.uniform(problem.action_lower, problem.action_upper, (2000, problem.n_actions))
    d = law.draw(generator, 2000)
    before = None
    for substeps in 2 ** np.arange(9):
        step = Elementwise(discretise(problem.model, problem.sampling_time, int(substeps)))
        x_next = np.stack(
            [np.broadcast_to(e, 2000) for e in step(x.T, u.T, d.T, parameters)], axis=1
        )
        if before is not None and np.all(np.abs(x_next - before) <= tolerance * (1 + np.abs(x))):
            return int(substeps)
        before = x_next
    raise OptimumError(
        f"model '{problem.model.name}': 256 RK4 substeps a sample do not integrate it to "
        f"{tolerance:g}; shorten the sampling time"
    )
