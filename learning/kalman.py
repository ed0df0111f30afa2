"""Recursive Bayesian regression: the Kalman form of a fit with a prior on θ."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.fit import Fit

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
OUTLIER = 25.0
"""Squares of innovations beyond this many variances count as this many."""


class KalmanRegression:
    """d ~ N(0, I) in scaled coordinates; each δ measures ∇Qᵀd with variance r.

        K = P∇Q/(r + ∇QᵀP∇Q),  d ← d + K·clip(δ − ∇Qᵀd),  P ← P − K∇QᵀP

    Without clip and with r constant this is the ridge regression min Σ(δ−∇Qᵀd)²/r + ‖d‖². The
    innovation is cut at ±`clip`·√r; r follows the mean square of the innovations with a memory of
    `memory` samples. `drift` is added to P's diagonal at each sample.
    """

    def __init__(
        self, size: int, variance: float, *, clip: float, memory: float, drift: float = 0.0
    ) -> None:
        self._clip, self._memory, self._drift = clip, memory, drift
        self.covariance: Matrix = np.eye(size)
        self.mean: Vector = np.zeros(size)
        self.variance = variance

    def update(self, td_error: float, gradient: Vector) -> float:
        """Take δ and ∇Q (n,), scaled; returns the innovation δ − ∇Qᵀd."""
        spread = self.covariance @ gradient
        scale = self.variance + float(gradient @ spread)
        innovation = td_error - float(gradient @ self.mean)
        limit = self._clip * self.variance**0.5
        gain = spread / scale
        self.mean += gain * min(max(innovation, -limit), limit)
        self.covariance -= gain[:, None] * spread
        if self._drift:
            self.covariance[np.diag_indices_from(self.covariance)] += self._drift
        square = min(innovation * innovation, OUTLIER * self.variance)
        self.variance += (square - self.variance) / self._memory
        return innovation

    def fit(self) -> Fit:
        """The step d as a fit in the metric P⁻¹, for constraints that it violates."""
        covariance = (self.covariance + self.covariance.T) / 2
        information: Matrix = np.linalg.inv(covariance).astype(np.float64)
        return Fit(information @ self.mean, self.mean.copy(), lambda: information)

    def taken(self) -> None:
        """The step has gone into θ: d starts from zero again, P stays."""
        self.mean[:] = 0.0

    def state(self) -> dict[str, NDArray[Any]]:
        """Mean, covariance and variance."""
        return {
            "mean": self.mean.copy(),
            "covariance": self.covariance.copy(),
            "variance": np.array(self.variance),
        }

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self.mean, self.covariance = state["mean"].copy(), state["covariance"].copy()
        self.variance = float(state["variance"])
