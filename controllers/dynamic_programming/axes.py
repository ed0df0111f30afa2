"""Where to put the grid's points: dense where the controlled plant lives, sparse elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.bellman import BellmanOperator
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.quadrature import DisturbanceLaw
from controllers.dynamic_programming.settings import Settings
from controllers.problem import Problem

Array = NDArray[np.float64]


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
    problem: Problem,
    law: DisturbanceLaw,
    grid: Grid,
    distribution: Array,
    settings: Settings,
    level: int,
) -> Grid:
    """Grid that resolves the support of a distribution (G,) with cells·2^level cells a state.

    It reaches as far again beyond the support on either side, and at least a twentieth of the
    bounds' span: farther states are so rare that the policy at the box's edge serves them.
    Without disturbance the support is a point, which says nothing of that, and the box stays.
    """
    share = 1.0 if law.deterministic else 0.05
    margin = share * (problem.state_upper - problem.state_lower)
    mass = np.maximum(distribution, 0.0).reshape(grid.shape)
    axes = []
    for i, axis in enumerate(grid.axes):
        others = tuple(j for j in range(mass.ndim) if j != i)
        first, last = support(axis, mass.sum(axis=others), settings.tail)
        width = last - first
        spacing = width / (settings.cells * 2**level)
        beyond = max(width, margin[i])
        low = max(axis[0], min(first, problem.reference_state[i]) - beyond)
        high = min(axis[-1], max(last, problem.reference_state[i]) + beyond)
        axes.append(graded_axis(low, high, first, last, spacing, settings.growth))
    return Grid(tuple(axes))


def graded_axis(
    lower: float, upper: float, first: float, last: float, spacing: float, growth: float
) -> Array:
    """Axis on [lower, upper]: `spacing` between first and last, growing by `growth` outwards.

    Equidistant points fill [first, last] at no more than `spacing`; each further cell is `growth`
    times as wide as its neighbour, up to the ends.
    """
    first, last = max(first, lower), min(last, upper)
    count = max(int(np.ceil((last - first) / spacing - 1e-9)), 1)
    core = np.linspace(first, last, count + 1)
    below = first - _outward(first - lower, spacing, growth)
    above = last + _outward(upper - last, spacing, growth)
    return np.concatenate([below[::-1], core, above])


def _outward(length: float, spacing: float, growth: float) -> Array:
    """Offsets of geometrically growing cells that end exactly at `length`."""
    if length <= 1e-9 * spacing:
        return np.zeros(0)
    count = max(int(np.ceil(np.log1p(length * (growth - 1) / spacing) / np.log(growth))), 1)
    offsets: Array = np.cumsum(spacing * growth ** np.arange(1, count + 1))
    scaled: Array = offsets * (length / offsets[-1])
    return scaled


def support(axis: Array, mass: Array, tail: float) -> tuple[float, float]:
    """Interval of an axis that holds all but `tail` of the mass (per axis point) at each end.

    One more cell on either side is included.
    """
    cumulative = np.cumsum(mass) / mass.sum()
    low = int(np.searchsorted(cumulative, tail))
    high = int(np.searchsorted(cumulative, 1.0 - tail))
    return float(axis[max(low - 1, 0)]), float(axis[min(high + 1, len(axis) - 1)])
