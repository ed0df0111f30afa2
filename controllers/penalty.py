"""The penalty of the state bounds, Σᵢ bᵢ vᵢ + Bᵢ vᵢ² with v = max(x_l − x, x − x_u, 0)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StatePenalty:
    """Exact penalty of a state beyond its bounds (paper.tex, Simulations).

    `lower`, `upper` (n,) are x_l and x_u; `linear` b and `quadratic` B (n,) the weights.
    """

    lower: Vector
    upper: Vector
    linear: Vector
    quadratic: Vector

    def __call__(self, s: Sequence[float] | Vector) -> float:
        """Penalty of one state (n,), fastest for a list."""
        total = 0.0
        for x, (low, high, linear, quadratic) in zip(s, self._rows, strict=True):
            violation = max(low - x, x - high, 0.0)
            total += (linear + quadratic * violation) * violation
        return total

    def symbolic(self, s: ca.SX) -> ca.SX:
        """The same as a CasADi expression of a state (n,)."""
        violation = ca.fmax(ca.fmax(self.lower - s, s - self.upper), 0)
        return ca.dot(self.linear, violation) + ca.dot(self.quadratic, violation**2)

    @cached_property
    def _rows(self) -> list[tuple[float, float, float, float]]:
        columns = (self.lower, self.upper, self.linear, self.quadratic)
        return list(zip(*(column.tolist() for column in columns), strict=True))
