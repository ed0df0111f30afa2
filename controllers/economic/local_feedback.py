"""The linear-quadratic optimum at a steady state, on the constraints that stay active."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, solve_discrete_are

from controllers.errors import TuningError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalFeedback:
    """Optimal u = K x of min Σ ½ wᵀHw, w = (x, u), x₊ = Ax + Bu, with value ½ xᵀPx.

    `gain` K (m, n); `value` P (n, n), symmetric; both for γ = 1.
    """

    gain: Array
    value: Array


def local_feedback(A: Array, B: Array, H: Array, C: Array) -> LocalFeedback:
    """Solve the Riccati equation on the manifold C w_k = 0, k ≥ 1, of the active constraints.

    A row of `C` (n_c, n+m) that has an entry in u binds from k = 0 on; one of the state alone binds
    the next state. H (n+m, n+m) may be indefinite. Raises TuningError where the actions cannot
    keep the constraints, or no stabilising solution exists.
    """
    n, m = B.shape
    on_action = np.abs(C[:, n:]).max(axis=1, initial=0.0) > 0
    rows = np.vstack([C[on_action], C[~on_action, :n] @ np.hstack([A, B])])
    # Actions that keep the constraints: u = particular x + free v.
    gain, free = np.zeros((m, n)), np.eye(m)
    if len(rows):
        if np.linalg.matrix_rank(rows[:, n:]) < len(rows):
            raise TuningError(
                f"the {len(rows)} active constraints cannot all be kept by the {m} actions within "
                "one sample: local feedback is not defined by them"
            )
        gain = -np.linalg.pinv(rows[:, n:]) @ rows[:, :n]
        free = null_space(rows[:, n:])
    if free.shape[1]:
        gain = gain + free @ _reduced_gain(A, B, H, gain, free)
    closed, stage = A + B @ gain, np.vstack([np.eye(n), gain])
    return LocalFeedback(gain, _lyapunov(closed, stage.T @ H @ stage))


def _reduced_gain(A: Array, B: Array, H: Array, particular: Array, free: Array) -> Array:
    """Gain of v in u = particular x + free v, from the Riccati equation."""
    n = len(A)
    change = np.block([[np.eye(n), np.zeros((n, free.shape[1]))], [particular, free]])
    reduced = change.T @ H @ change
    a, b = A + B @ particular, B @ free
    q, r, s = reduced[:n, :n], reduced[n:, n:], reduced[:n, n:]
    try:
        P = solve_discrete_are(a, b, q, r, s=s)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise TuningError(
            f"the steady state has no stabilising local feedback of finite cost ({error})"
        ) from error
    curvature = r + b.T @ P @ b
    if np.linalg.eigvalsh(0.5 * (curvature + curvature.T)).min() <= 0:
        raise TuningError("the steady state is no local minimum of the economic cost")
    gain: Array = -np.linalg.solve(curvature, b.T @ P @ a + s.T)
    return gain


def _lyapunov(closed: Array, stage: Array) -> Array:
    """P = stage + closedᵀ P closed; raises TuningError where the closed loop is unstable.

    More accurate than the Riccati solver's P, of which only the gain's part is well conditioned.
    """
    n = len(closed)
    if np.abs(np.linalg.eigvals(closed)).max() >= 1:
        raise TuningError("the active constraints, once kept, make the closed loop unstable")
    system = np.eye(n * n) - np.kron(closed.T, closed.T)
    P = np.linalg.solve(system, stage.reshape(-1)).reshape(n, n)
    symmetric: Array = 0.5 * (P + P.T)
    return symmetric
