"""Piecewise polynomial interpolation along one axis of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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
    """Cubic through four points in the cells that lie within `smooth`, linear in the others.

    The cubic of a cell runs through its two ends and the next point on either side; at an end of
    the cubic cells through the four points nearest to it that they have, so that none reaches
    out to where there may be a kink. Fewer than four points within `smooth` leave all linear.
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
