"""The critic: LSTDV for the smooth part of the value, LSTDQ for the compatible advantage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


def quadratic_features(states: Matrix, centre: Vector, spread: Vector) -> Matrix:
    """1, z_i and z_i z_j (i ≤ j) of z = (s − centre) / spread; (K, n) → (K, 1+n+n(n+1)/2)."""
    z = (states - centre) / spread
    rows, columns = np.triu_indices(states.shape[1])
    return np.hstack([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns]])


def lstdv(states: Matrix, next_states: Matrix, reward: Vector, discount: float) -> Vector:
    """TD errors of the quadratic value function that LSTD fits to transitions, (K,).

    W(s) = vᵀφ(s) with E[φ (r + γW(s₊) − W(s))] = 0. At γ = 1 the mean cost per sample g takes the
    place of the constant feature, W(s) = r − g + W(s₊): the differential value.
    """
    centre, spread = states.mean(axis=0), states.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    features = quadratic_features(states, centre, spread)
    change = features - discount * quadratic_features(next_states, centre, spread)
    if discount == 1.0:
        change[:, 0] = 1.0
    weights = np.linalg.lstsq(features.T @ change, features.T @ reward)[0]
    errors: Vector = reward - change @ weights
    return errors


class AdvantageRegression:
    """LSTDQ for the weights w (n_θ,) of the compatible advantage A = ψᵀw, given LSTDV's TD errors.

    The policy is greedy in s₊, where A vanishes, so LSTDQ with V held is a regression of the TD
    errors on ψ. Earlier batches count too, each `forgetting` times as much as the next one: θ
    moves little from batch to batch, and the gradient's noise is what limits learning. `ridge` is
    relative to the mean of the information's diagonal.
    """

    def __init__(self, size: int, forgetting: float, ridge: float) -> None:
        self._forgetting, self._ridge = forgetting, ridge
        self.information: Matrix = np.zeros((size, size))
        self.moment: Vector = np.zeros(size)

    def add(self, features: Matrix, td_errors: Vector) -> None:
        """Take a batch: ψ (K, n_θ) and TD errors (K,)."""
        self.information = self._forgetting * self.information + features.T @ features
        self.moment = self._forgetting * self.moment + features.T @ td_errors

    def weights(self) -> Vector:
        """Regression's w, (n_θ,)."""
        size = self.moment.size
        floor = max(float(np.trace(self.information)), np.finfo(float).tiny) / size
        factor = cho_factor(self.information + self._ridge * floor * np.eye(size))
        weights: Vector = cho_solve(factor, self.moment)
        return weights
