"""A grid of states: its axes, and interpolation on it, cubic where that is smooth."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cosim.protocols import Array

Indices = NDArray[np.intp]


POINTS = 4


@dataclass(frozen=True)
class AxisInterpolant:
    """The polynomials through the points of an axis, one a cell.

    In cell c, x = axis[c] + t, the weight of point `first`[c] + j is Σ_i `weights`[i, j, c] tⁱ,
    `weights` (powers, stencil points, cells).
    """

    axis: Array
    first: Indices
    weights: Array

    def locate(self, x: Array) -> tuple[Indices, Array]:
        """Cells of coordinates and offsets in them; outside the axis, those of its ends."""
        inside = np.clip(x, self.axis[0], self.axis[-1])
        cell = np.searchsorted(self.axis[1:-1], inside, side="right")
        return cell, inside - self.axis[cell]


def axis_interpolant(axis: Array, smooth: tuple[float, float] | None) -> AxisInterpolant:
    """Cubic interpolant in the cells within `smooth`, linear in the others.

    A cell's cubic runs through its ends and the next point on either side. No cubic uses a point
    outside `smooth`, where there may be a kink; fewer than four points within leave all linear.
    """
    cells = np.arange(len(axis) - 1)
    lower, upper = smooth or (np.inf, -np.inf)
    tolerance = 1e-9 * (axis[-1] - axis[0])
    cubic = (axis[:-1] >= lower - tolerance) & (axis[1:] <= upper + tolerance)
    count = POINTS if cubic.sum() >= POINTS - 1 else 2
    first = np.clip(cells - (count // 2 - 1), 0, len(axis) - count)
    if count == POINTS:
        within = np.flatnonzero(cubic)
        first[cubic] = np.clip(first[cubic], within[0], within[-1] + 2 - POINTS)
    weights = np.zeros((count, count, len(cells)))
    for c in cells:
        start, points = (first[c], POINTS) if count == POINTS and cubic[c] else (c, 2)
        for j in range(start, start + points):
            polynomial = np.ones(1)
            for k in range(start, start + points):
                if k != j:
                    step = axis[j] - axis[k]
                    polynomial = np.convolve(polynomial, [(axis[c] - axis[k]) / step, 1 / step])
            weights[: len(polynomial), j - first[c], c] = polynomial
    return AxisInterpolant(axis, first, weights)


@dataclass(frozen=True)
class Grid:
    """The product of increasing axes, one per state, at least two points each.

    `smooth` has an interval per state in which interpolation is cubic; elsewhere it is multilinear.
    Weights sum to one; multilinear ones are non-negative too, as those of a Markov chain. A state
    outside the box is moved to the nearest one inside.
    """

    axes: tuple[Array, ...]
    smooth: tuple[tuple[float, float], ...] | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of points per state."""
        return tuple(len(axis) for axis in self.axes)

    @property
    def size(self) -> int:
        """Number of grid states G."""
        return int(np.prod(self.shape))

    @cached_property
    def points(self) -> Array:
        """Grid states, shape (G, n), the last state running fastest."""
        mesh = np.meshgrid(*self.axes, indexing="ij")
        return np.stack([axis.reshape(-1) for axis in mesh], axis=1)

    @cached_property
    def boundary(self) -> NDArray[np.bool_]:
        """Which grid states lie on the edge of the box, shape (G,)."""
        on_edge = np.zeros(self.size, dtype=bool)
        for axis, column in zip(self.axes, self.points.T, strict=True):
            on_edge |= (column == axis[0]) | (column == axis[-1])
        return on_edge

    def nearest(self, state: Sequence[float] | Array) -> int:
        """Index of the grid state nearest to `state` in each coordinate."""
        index = [int(np.abs(axis - x).argmin()) for axis, x in zip(self.axes, state, strict=True)]
        return int(np.ravel_multi_index(index, self.shape))

    def weights(self, x: Sequence[Array]) -> list[tuple[Indices, Array]]:
        """Grid indices and weights of interpolation at states given as one array per entry."""
        positions, factors = [], []
        strides = np.cumprod((1, *self.shape[:0:-1]))[::-1]
        for interpolant, stride, values in zip(self._interpolants, strides, x, strict=True):
            cell, offset = interpolant.locate(values)
            start = interpolant.first[cell]
            points = interpolant.weights.shape[1]
            positions.append([stride * (start + j) for j in range(points)])
            factors.append(
                [_horner(interpolant.weights[:, j], cell, [offset]) for j in range(points)]
            )
        result = []
        for stencil in itertools.product(*(range(len(row)) for row in positions)):
            index, weight = np.zeros((), dtype=np.intp), np.ones(())
            for position, factor, j in zip(positions, factors, stencil, strict=True):
                index, weight = index + position[j], weight * factor[j]
            result.append((index, weight))
        return result

    def interpolant(self, values: Array) -> Callable[[Sequence[Array]], Array]:
        """Function that interpolates `values` (G,) at states given as one array per entry."""
        table = values.reshape(self.shape)
        for interpolant in self._interpolants:
            stencil = interpolant.first + np.arange(interpolant.weights.shape[1])[:, None]
            # The first axis becomes (power, cell), and both go last.
            table = np.einsum("ijc,jc...->...ic", interpolant.weights, table[stencil])
        n = len(self.axes)
        table = table.transpose(*range(0, 2 * n, 2), *range(1, 2 * n, 2))
        table = np.ascontiguousarray(table.reshape(*table.shape[:n], -1))

        def function(x: Sequence[Array]) -> Array:
            index: Indices = np.zeros((), dtype=np.intp)
            offsets = []
            for interpolant, entry in zip(self._interpolants, x, strict=True):
                cell, offset = interpolant.locate(entry)
                index = index * (len(interpolant.axis) - 1) + cell
                offsets.append(offset)
            return _horner(table, index, offsets)

        return function

    @cached_property
    def _interpolants(self) -> list[AxisInterpolant]:
        smooth = self.smooth or (None,) * len(self.axes)
        return [axis_interpolant(a, within) for a, within in zip(self.axes, smooth, strict=True)]

    def resample(self, values: Array, other: Grid) -> Array:
        """Values (G, k) at the states of another grid, interpolated multilinearly."""
        x, linear = list(other.points.T), Grid(self.axes)
        return np.stack([linear.interpolant(column)(x) for column in values.T], axis=1)


def _horner(table: Array, index: Indices, offsets: Sequence[Array]) -> Array:
    if not offsets:
        return np.asarray(table[index])
    first, *rest = offsets
    total = _horner(table[-1], index, rest)
    for part in table[-2::-1]:
        total = total * first + _horner(part, index, rest)
    return total


Feature = tuple[float, float, float]
"""First and last point of an interval of an axis, and the width that its cells shall not exceed."""


def graded_axis(marks: Sequence[float], features: Sequence[Feature], growth: float) -> Array:
    """Axis through all `marks`, dense at features, each cell outwards about `growth` times wider.

    The width of a cell at x is the least over the features of spacing + (growth − 1)·distance.
    """
    parts = []
    for lower, upper in pairwise(marks):
        fine = np.linspace(lower, upper, 4001)
        middle = 0.5 * (fine[1:] + fine[:-1])
        width = np.full(len(middle), upper - lower)
        for first, last, spacing in features:
            distance = np.maximum(np.maximum(first - middle, middle - last), 0.0)
            np.minimum(width, spacing + (growth - 1.0) * distance, out=width)
        count = np.append(0.0, np.cumsum(np.diff(fine) / width))
        cells = max(int(np.ceil(count[-1] - 1e-6)), 1)
        inner = np.interp(np.arange(1, cells) * (count[-1] / cells), count, fine)
        parts.append(np.concatenate([[lower], inner]))
    return np.concatenate([*parts, [marks[-1]]])
