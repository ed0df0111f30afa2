"""A rectangular state grid with multilinear interpolation."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from controllers.errors import OptimumError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Grid:
    """The product of increasing axes, one per state, at least two points each.

    Interpolation weights are non-negative and sum to one, so that they are the row of a stochastic
    matrix: the interpolated dynamic programme is that of a Markov chain on the grid, with the
    contraction and the gain bounds that belong to it. A state outside is moved to the nearest
    state of the box.
    """

    axes: tuple[Array, ...]

    def __post_init__(self) -> None:
        """Freeze and check the axes."""
        axes = tuple(np.array(axis, dtype=np.float64) for axis in self.axes)
        for axis in axes:
            if axis.ndim != 1 or len(axis) < 2 or not (np.diff(axis) > 0).all():
                raise OptimumError(
                    f"grid: an axis needs at least two increasing points, not {axis}"
                )
            axis.flags.writeable = False
        object.__setattr__(self, "axes", axes)

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

    def corners(self, x: Sequence[Array]) -> list[tuple[Indices, Array]]:
        """Grid indices and weights of the 2ⁿ corners around states given as one array per entry."""
        cells, fractions = [], []
        for axis, values in zip(self.axes, x, strict=True):
            cell = np.clip(np.searchsorted(axis, values) - 1, 0, len(axis) - 2)
            left = axis[cell]
            fractions.append(np.clip((values - left) / (axis[cell + 1] - left), 0.0, 1.0))
            cells.append(cell)
        strides = np.cumprod((1, *self.shape[:0:-1]))[::-1]
        base = sum(cell * stride for cell, stride in zip(cells, strides, strict=True))
        result = []
        for upper in itertools.product((False, True), repeat=len(cells)):
            weight: Array = np.ones(())
            for fraction, high in zip(fractions, upper, strict=True):
                weight = weight * (fraction if high else 1.0 - fraction)
            result.append((base + int(np.dot(upper, strides)), weight))
        return result

    def interpolate(self, values: Array, x: Sequence[Array]) -> Array:
        """Interpolate `values` (G,) at states given as one array per entry of the state."""
        total: Array = np.zeros(())
        for index, weight in self.corners(x):
            total = total + weight * values[index]
        return total

    def resample(self, values: Array, other: Grid) -> Array:
        """Values (G,) or (G, k) of this grid, interpolated at the states of another one."""
        x = list(other.points.T)
        if values.ndim == 1:
            return self.interpolate(values, x)
        return np.stack([self.interpolate(column, x) for column in values.T], axis=1)
