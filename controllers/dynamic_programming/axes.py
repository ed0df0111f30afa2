"""Where to put the grid's points: dense where the controlled plant lives, sparse elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
