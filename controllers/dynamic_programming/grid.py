"""A grid of states: its axes, and interpolation on it by cubics and linear functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cosim.core.protocols import Array

Indices = NDArray[np.intp]
Interval = tuple[float, float]
CUBIC_POINTS = 4
"""Points of an axis that a cubic goes through."""


class AxisInterpolant:
    """Polynomials through the points of an axis: cubic in the cells within `smooth`, linear else.

    In cell c, x = axis[c] + t, the weight of point `first`[c] + j is Σ_i `weights`[i, j, c] tⁱ,
    `weights` (powers, stencil points, cells). A cell's cubic runs through its ends and the next
    point on either side. No cubic uses a point outside `smooth`, where there may be a kink; fewer
    than four points within leave all linear.
    """

    def __init__(self, axis: Array, smooth: Interval | None) -> None:
        n_points = len(axis)
        n_cells = n_points - 1
        cubic = _cells_within(axis, smooth)
        any_cubic = cubic.sum() >= CUBIC_POINTS - 1
        stencil_size = CUBIC_POINTS if any_cubic else 2

        # The stencil is about the cell, but within the axis, and a cubic's within the smooth part.
        centred = np.arange(n_cells) - (stencil_size // 2 - 1)
        first = np.clip(centred, 0, n_points - stencil_size)
        if any_cubic:
            cubic_cells = np.flatnonzero(cubic)
            # Cell c lies between the points c and c + 1.
            least_first = cubic_cells[0]
            last_point = cubic_cells[-1] + 1
            largest_first = last_point + 1 - CUBIC_POINTS
            first[cubic] = np.clip(first[cubic], least_first, largest_first)

        weights = np.zeros((stencil_size, stencil_size, n_cells))
        for c in range(n_cells):
            begin = first[c]
            origin = axis[c]
            points = range(c, c + 2)
            if any_cubic and cubic[c]:
                points = range(begin, begin + CUBIC_POINTS)
            # Linear cells leave the powers and points beyond theirs at zero.
            for j in points:
                polynomial = _lagrange_polynomial(axis, j, points, origin)
                n_powers = len(polynomial)
                weights[:n_powers, j - begin, c] = polynomial

        self.axis = axis
        self.first = first
        self.weights = weights

    def locate(self, x: Array) -> tuple[Indices, Array]:
        """Cells of coordinates and offsets in them; outside the axis, those of its ends."""
        lowest = self.axis[0]
        highest = self.axis[-1]
        inside = np.clip(x, lowest, highest)
        inner_points = self.axis[1:-1]
        cell = np.searchsorted(inner_points, inside, side="right")
        offset = inside - self.axis[cell]
        return cell, offset

    def stencil(self, x: Array) -> list[tuple[Indices, Array]]:
        """Points of the axis by which values at x are interpolated, and their weights."""
        cell, offset = self.locate(x)
        first = self.first[cell]
        _, stencil_size, _ = self.weights.shape
        points = []
        for j in range(stencil_size):
            coefficients = self.weights[:, j]
            weight = _horner(coefficients, cell, [offset])
            points.append((first + j, weight))
        return points


def _cells_within(
    axis: Array,
    interval: Interval | None,
) -> NDArray[np.bool_]:
    """Which cells of an axis lie in an interval, up to rounding; none where it is None."""
    if interval is None:
        return np.zeros(len(axis) - 1, dtype=bool)
    lower, upper = interval
    tolerance = 1e-9 * (axis[-1] - axis[0])
    begins = axis[:-1]
    ends = axis[1:]
    begins_within = begins >= lower - tolerance
    ends_within = ends <= upper + tolerance
    return np.asarray(begins_within & ends_within)


def _lagrange_polynomial(
    axis: Array,
    j: int,
    points: Sequence[int],
    origin: float,
) -> Array:
    """Coefficients, in powers of x − origin, of the polynomial that is 1 at axis[j], 0 at others.

    The others are the points of the axis with the indices `points`.
    """
    polynomial = np.ones(1)
    for k in points:
        if k == j:
            continue
        # The factor (x − axis[k]) / (axis[j] − axis[k]).
        width = axis[j] - axis[k]
        constant = (origin - axis[k]) / width
        slope = 1 / width
        polynomial = np.convolve(polynomial, [constant, slope])
    return polynomial


@dataclass(frozen=True)
class Grid:
    """The product of increasing axes, one per state, at least two points each.

    `smooth` has an interval per state in which interpolation is cubic; elsewhere it is multilinear.
    Weights sum to one; multilinear ones are non-negative too, as those of a Markov chain. A state
    outside the box is moved to the nearest one inside.
    """

    axes: tuple[Array, ...]
    smooth: tuple[Interval, ...] | None = None

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
        columns = [coordinate.reshape(-1) for coordinate in mesh]
        return np.stack(columns, axis=1)

    def nearest(self, state: Sequence[float] | Array) -> int:
        """Index of the grid state nearest to `state` in each coordinate."""
        index = []
        for axis, x in zip(self.axes, state, strict=True):
            distance = np.abs(axis - x)
            index.append(int(distance.argmin()))
        return int(np.ravel_multi_index(index, self.shape))

    def weights(self, x: Sequence[Array]) -> list[tuple[Indices, Array]]:
        """Grid indices and weights of interpolation at states given as one array per entry."""
        # The empty product: one corner, at index 0, of weight 1.
        origin: Indices = np.zeros((), dtype=np.intp)
        one = np.ones(())
        corners: list[tuple[Indices, Array]] = [(origin, one)]
        for interpolant, values in zip(self._interpolants, x, strict=True):
            n_points = len(interpolant.axis)
            stencil = interpolant.stencil(values)
            # Each corner so far has one successor for each point of this axis' stencil.
            extended = []
            for index, weight in corners:
                for position, factor in stencil:
                    index_here = index * n_points + position
                    weight_here = weight * factor
                    extended.append((index_here, weight_here))
            corners = extended
        return corners

    def interpolant(self, values: Array) -> Callable[[Sequence[Array]], Array]:
        """Function that interpolates `values` (G,) at states given as one array per entry."""
        # Coefficients of the polynomial of each cell: one axis after the other.
        table = values.reshape(self.shape)
        for interpolant in self._interpolants:
            weights = interpolant.weights
            _, stencil_size, _ = weights.shape
            steps = np.arange(stencil_size)
            stencil = interpolant.first + steps[:, None]
            values_at_points = table[stencil]
            # The first axis becomes (power, cell), and both go last.
            table = np.einsum("ijc,jc...->...ic", weights, values_at_points)

        # Powers first, as `_horner` reads them; the cells behind them become one axis.
        n = len(self.axes)
        powers = range(0, 2 * n, 2)
        cells = range(1, 2 * n, 2)
        table = table.transpose(*powers, *cells)
        n_powers = table.shape[:n]
        flat = table.reshape(*n_powers, -1)
        table = np.ascontiguousarray(flat)

        def function(x: Sequence[Array]) -> Array:
            # The number of the cell among all, the last axis running fastest.
            index: Indices = np.zeros((), dtype=np.intp)
            offsets = []
            for interpolant, entry in zip(self._interpolants, x, strict=True):
                cell, offset = interpolant.locate(entry)
                n_cells = len(interpolant.axis) - 1
                index = index * n_cells + cell
                offsets.append(offset)
            return _horner(table, index, offsets)

        return function

    @cached_property
    def _interpolants(self) -> list[AxisInterpolant]:
        n_axes = len(self.axes)
        none: tuple[None, ...] = (None,) * n_axes
        smooth = self.smooth or none
        interpolants = []
        for axis, interval in zip(self.axes, smooth, strict=True):
            interpolants.append(AxisInterpolant(axis, interval))
        return interpolants


def _horner(
    table: Array,
    index: Indices,
    offsets: Sequence[Array],
) -> Array:
    """Polynomial in `offsets` of the coefficients `table[i, j, …, index]`, by Horner's rule."""
    if not offsets:
        return np.asarray(table[index])
    first, *rest = offsets
    total = _horner(table[-1], index, rest)
    for part in table[-2::-1]:
        total = total * first + _horner(part, index, rest)
    return total


Feature = tuple[float, float, float]
"""First and last point of an interval of an axis, and the width that its cells shall not exceed."""


def graded_axis(
    marks: Sequence[float],
    features: Sequence[Feature],
    growth: float,
) -> Array:
    """Axis through all `marks`, dense at features, each cell outwards about `growth` times wider.

    The width of a cell at x is the least over the features of spacing + (growth − 1)·distance.

    Args:
        marks: Points of the axis, increasing: the first and last ones are its ends.
        features: Where the axis is dense.
        growth: Ratio of the widths of neighbouring cells, above 1.
    """
    pieces = []
    for lower, upper in pairwise(marks):
        piece = _graded_piece(lower, upper, features, growth)
        pieces.append(piece)
    end = np.array([marks[-1]])
    return np.concatenate([*pieces, end])


def _graded_piece(
    lower: float,
    upper: float,
    features: Sequence[Feature],
    growth: float,
) -> Array:
    """The points of `graded_axis` between two marks, the lower one included."""
    # The wanted width of a cell, as a function of its place, on a fine partition.
    fine = np.linspace(lower, upper, 4001)
    begins = fine[:-1]
    ends = fine[1:]
    middle = 0.5 * (ends + begins)
    width = np.full(len(middle), upper - lower)
    for first, last, spacing in features:
        outside = np.maximum(first - middle, middle - last)
        distance = np.maximum(outside, 0.0)
        allowed = spacing + (growth - 1.0) * distance
        np.minimum(width, allowed, out=width)

    # Number of cells from `lower` to each point, the integral of 1/width. The axis has the points
    # where it is a whole number, after the last count is rounded up to one.
    increments = np.diff(fine) / width
    count = np.append(0.0, np.cumsum(increments))
    total = count[-1]
    rounded_up = int(np.ceil(total - 1e-6))
    n_cells = max(rounded_up, 1)
    count_of_a_cell = total / n_cells
    whole = np.arange(1, n_cells) * count_of_a_cell
    inner = np.interp(whole, count, fine)
    return np.append(lower, inner)
