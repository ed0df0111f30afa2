"""Where to put the grid's points: dense where the controlled plant lives, sparse elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.bellman import BellmanOperator
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.settings import Settings
from controllers.problem import Problem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Feature:
    """An interval of an axis whose cells shall be no wider than `spacing`."""

    first: float
    last: float
    spacing: float


def first_grid(problem: Problem, operator: BellmanOperator, settings: Settings) -> Grid:
    """Grid over all states within the bounds and a tenth beyond.

    Its cells are half a standard deviation of one sample's disturbance wide at the reference and
    at the bounds, where the optimal closed loop may live.
    """
    deviation = operator.deviation(problem.reference_state, problem.reference_action)
    axes = []
    for low, high, centre, sigma in zip(
        problem.state_lower, problem.state_upper, problem.reference_state, deviation, strict=True
    ):
        span = high - low
        spacing = max(0.5 * sigma, 1e-3 * span)
        features = [Feature(x - spacing, x + spacing, spacing) for x in (low, centre, high)]
        lower, upper = low - 0.1 * span, high + 0.1 * span
        marks = sorted({lower, low, centre, high, upper})
        axes.append(graded_axis(marks, features, settings.growth**2))
    return Grid(tuple(axes))


def finer_grid(
    operator: BellmanOperator,
    grid: Grid,
    actions: Array,
    distribution: Array,
    settings: Settings,
    level: int,
    *,
    smooth: bool = True,
) -> Grid:
    """Grid that resolves the support of a distribution with cells·2^level cells a state.

    At a bound that the closed loop of `actions` (G, m) touches, whose stationary `distribution`
    is (G,), the cells are 2^-level of the standard deviation of one sample's disturbance: the
    penalty's kink reaches the value of a slow state smoothed by no more than that. It extends as
    far again beyond the support on either side, and at least a twentieth of the bounds' span:
    farther states are so rare that the policy at the box's edge serves them. Without disturbance
    the support is a point, which says nothing of that, and the box stays. `smooth`: cubic
    interpolation within the support, else linear everywhere.
    """
    problem = operator.problem
    span = problem.state_upper - problem.state_lower
    mass = np.maximum(distribution, 0.0)
    mean = mass @ np.column_stack([grid.points, actions]) / mass.sum()
    deviation = operator.deviation(mean[: problem.n_states], mean[problem.n_states :])
    mass = mass.reshape(grid.shape)
    axes, intervals = [], []
    for i, axis in enumerate(grid.axes):
        others = tuple(j for j in range(mass.ndim) if j != i)
        first, last = support(axis, mass.sum(axis=others), settings.tail)
        reference, width = problem.reference_state[i], last - first
        features = [Feature(first, last, width / (settings.cells * 2**level))]
        bounds = [
            bound
            for bound in (problem.state_lower[i], problem.state_upper[i])
            if first - deviation[i] <= bound <= last + deviation[i]
        ]
        near = max(deviation[i], 1e-3 * span[i])
        features += [Feature(b - near, b + near, near / 2**level) for b in bounds]
        beyond = max(width, (1.0 if operator.deterministic else 0.05) * span[i])
        low = max(axis[0], min(first, reference) - beyond)
        high = min(axis[-1], max(last, reference) + beyond)
        marks = [low, *(x for x in sorted({*bounds, reference}) if low < x < high), high]
        axes.append(graded_axis(marks, features, settings.growth))
        # Beyond a bound the value has kinks wherever one more sample is needed to return.
        intervals.append((max(first, problem.state_lower[i]), min(last, problem.state_upper[i])))
    return Grid(tuple(axes), tuple(intervals) if smooth else None)


def graded_axis(marks: Sequence[float], features: Sequence[Feature], growth: float) -> Array:
    """Axis through all `marks`, dense at features, each cell outwards about `growth` times wider.

    The width of a cell at x is the least over the features of spacing + (growth − 1)·distance.
    """
    parts = []
    for lower, upper in pairwise(marks):
        fine = np.linspace(lower, upper, 4001)
        middle = 0.5 * (fine[1:] + fine[:-1])
        width = np.full(len(middle), upper - lower)
        for feature in features:
            distance = np.maximum(np.maximum(feature.first - middle, middle - feature.last), 0.0)
            np.minimum(width, feature.spacing + (growth - 1.0) * distance, out=width)
        count = np.append(0.0, np.cumsum(np.diff(fine) / width))
        cells = max(int(np.ceil(count[-1] - 1e-6)), 1)
        inner = np.interp(np.arange(1, cells) * (count[-1] / cells), count, fine)
        parts.append(np.concatenate([[lower], inner]))
    return np.concatenate([*parts, [marks[-1]]])


def support(axis: Array, mass: Array, tail: float) -> tuple[float, float]:
    """Interval of an axis that holds all but `tail` of the mass (per axis point) at each end.

    One more cell on either side is included.
    """
    cumulative = np.cumsum(mass) / mass.sum()
    low = int(np.searchsorted(cumulative, tail))
    high = int(np.searchsorted(cumulative, 1.0 - tail))
    return float(axis[max(low - 1, 0)]), float(axis[min(high + 1, len(axis) - 1)])
