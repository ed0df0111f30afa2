"""The known cost of leaving the state bounds, shared by plant, environment and results."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

VIOLATING = 1e-6
"""Violation Σᵢ vᵢ, in the states' units, above which a sample counts as violating.

A controller that holds a state on its bound crosses it by rounding, by 1e-12, at every other
sample: that is no violation to report. Mean violation, penalty and J take violations as they are.
"""


class Penalty:
    """Exact penalty of the state bounds, Σᵢ bᵢ vᵢ + Bᵢ vᵢ² with v = max(x_l − x, x − x_u, 0).

    Source: paper.tex, Simulations (b_σ = 10⁵·1, B_σ = I, at the true bounds).

    `lower` and `upper` (n,) are the bounds x_l, x_u in the states' units, `linear` and `quadratic`
    (n,) the weights b (cost per unit) and B (cost per unit²).
    """

    def __init__(
        self, lower: ArrayLike, upper: ArrayLike, linear: ArrayLike, quadratic: ArrayLike
    ) -> None:
        self.lower = np.asarray(lower, dtype=float)
        self.upper = np.asarray(upper, dtype=float)
        self.linear = np.asarray(linear, dtype=float)
        self.quadratic = np.asarray(quadratic, dtype=float)
        columns = (self.lower, self.upper, self.linear, self.quadratic)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        self._rows = tuple((i, *row) for i, row in enumerate(rows))

    def __call__(self, state: Sequence[float] | NDArray[np.float64]) -> float:
        """Penalty of one state (n,), fastest for a list; a NaN state gives NaN."""
        total = 0.0
        for i, lower, upper, linear, quadratic in self._rows:
            x = state[i]
            if lower <= x <= upper:
                continue
            v = lower - x if x < lower else x - upper
            total += linear * v + quadratic * v * v
        return float(total)

    def along(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Penalty of each of K states (K, n), to the bits of a call."""
        total = np.zeros(len(states))
        for v, linear, quadratic in zip(
            self.violation(states).T, self.linear, self.quadratic, strict=True
        ):
            total += linear * v + quadratic * v * v
        return total

    def violation(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Violation v ≥ 0 of each bound for states (…, n), same shape and units."""
        outside: NDArray[np.float64] = np.maximum(self.lower - states, states - self.upper)
        return np.maximum(outside, 0.0)
