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


def lstdq(advantage_features: Matrix, td_errors: Vector, ridge: float) -> Vector:
    """Weights w of the compatible advantage A = ψᵀw, (n_θ,), given LSTDV's TD errors.

    The policy is greedy in s₊, where A vanishes, so LSTDQ with V held is a regression of the TD
    errors on ψ (K, n_θ); its `ridge` is relative to the mean of the information's diagonal.
    """
    information = advantage_features.T @ advantage_features
    size = information.shape[0]
    floor = max(float(np.trace(information)), np.finfo(float).tiny) / size
    factor = cho_factor(information + ridge * floor * np.eye(size))
    weights: Vector = cho_solve(factor, advantage_features.T @ td_errors)
    return weights
