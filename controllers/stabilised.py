"""The QP of one sample in stabilised controls, for models that are unstable along the horizon.

Condensing writes every predicted state by the controls alone. Where the model is unstable these
responses grow as ρᴺ, the Hessian's condition number as ρ²ᴺ, and a solver loses its digits though
the QP is convex. With v_k = K_k ξ_k + c_k, K of the Riccati recursion along the horizon, responses
to c stay small and the Hessian in c is block-diagonal (prestabilisation: Rossiter, Kouvaritakis and
Rice, Automatica 34, 1998). The multipliers are those of the same limits.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np
from numpy.typing import NDArray

from controllers.errors import QpError
from controllers.qp import (
    DAQP_FIXED,
    DAQP_SETTINGS,
    DAQP_SOFT,
    DAQP_STATUS,
    NOT_CONVEX,
    QpSolution,
)
from cosim.core.protocols import Matrix, Vector


@dataclass(frozen=True)
class Stages:
    """A QP of N stages with n states and m controls, in units of `Problem.scale`.

        min  Σ_k ½w_kᵀL_k w_k + q_kᵀw_k + ½ξ_NᵀL_N ξ_N + q_Nᵀξ_N + Σ_i w_i t_i + W_i t_i²
        s.t. ξ_{k+1} = A_k ξ_k + B_k v_k + r_k,   lower ≤ v ≤ upper,
             state_lower − t ≤ ξ_1 … ξ_N ≤ state_upper + t,   t ≥ 0,   w_k = (ξ_k, v_k)

    Attributes:
        A: (N, n, n).
        B: (N, n, m).
        r: (N, n).
        L: (N, n+m, n+m).
        q: (N, n+m).
        L_N: (n, n).
        q_N: (n,).
        lower, upper: of the controls, (Nm,); equal where a control is enforced.
        state_lower, state_upper: of each stage's state, (n,).
        w, W: weights of the slack, (Nn,).
    """

    A: NDArray[np.float64]
    B: NDArray[np.float64]
    r: Matrix
    L: NDArray[np.float64]
    q: Matrix
    L_N: Matrix
    q_N: Vector
    lower: Vector
    upper: Vector
    state_lower: Vector
    state_upper: Vector
    w: Vector
    W: Vector


@dataclass(frozen=True)
class _Feedback:
    """The Riccati recursion: cost = Σ ½(c_k − b_k)ᵀ R_k (c_k − b_k) + const. for v = Kξ + c.

    Attributes:
        K: gains, (N, m, n).
        b: (N, m).
        R: curvatures, (N, m, m).
    """

    K: NDArray[np.float64]
    b: Matrix
    R: NDArray[np.float64]


def _riccati(stages: Stages) -> _Feedback:
    """The gains along the horizon; raises QpError where the QP is not convex."""
    horizon, n, m = stages.B.shape
    K = np.empty((horizon, m, n))
    b = np.empty((horizon, m))
    R = np.empty((horizon, m, m))
    # Cost to go ½ξᵀPξ + pᵀξ.
    P = stages.L_N
    p = stages.q_N
    for k in reversed(range(horizon)):
        A = stages.A[k]
        B = stages.B[k]
        L = stages.L[k]
        L_states = L[:n, :n]
        L_controls = L[n:, n:]
        L_mixed = L[n:, :n]
        q_states = stages.q[k, :n]
        q_controls = stages.q[k, n:]
        r = stages.r[k]

        # The cost of stage and rest in v_k, for ξ_{k+1} = A ξ_k + B v_k + r.
        curvature = L_controls + B.T @ P @ B
        coupling = L_mixed + B.T @ P @ A
        offset = P @ r + p
        slope = q_controls + B.T @ offset
        try:
            np.linalg.cholesky(curvature)
        except np.linalg.LinAlgError:
            raise QpError("the QP is not strictly convex", status=NOT_CONVEX) from None
        R[k] = (curvature + curvature.T) / 2
        K[k] = -np.linalg.solve(curvature, coupling)
        b[k] = -np.linalg.solve(curvature, slope)
        p = q_states + A.T @ offset + coupling.T @ b[k]
        P = L_states + A.T @ P @ A + coupling.T @ K[k]
        # Rounding takes the symmetry away, a little more each stage.
        P = (P + P.T) / 2
    return _Feedback(K, b, R)


def solve_stabilised(stages: Stages, xi_0: Vector) -> QpSolution:
    """Solve the QP for an initial state.

    Args:
        stages: The QP.
        xi_0: ξ_0, (n,).

    Returns:
        Controls v (Nm,), the multipliers ν of their bounds (Nm,) and λ of the soft rows (Nn,).

    Raises:
        QpError: The QP is not convex, or not solved.
    """
    horizon, n, m = stages.B.shape
    n_controls = horizon * m
    n_soft = horizon * n
    feedback = _riccati(stages)
    responses = _simulate_responses(stages, feedback, xi_0)
    free_controls = responses.free_controls
    free_states = responses.free_states

    # The recursion has completed the squares: the cost is Σ ½(c_k − b_k)ᵀ R_k (c_k − b_k).
    hessian = np.zeros((n_controls, n_controls))
    for k in range(horizon):
        own = slice(k * m, (k + 1) * m)
        hessian[own, own] = feedback.R[k]
    b = feedback.b.reshape(-1)
    gradient = -hessian @ b

    # The limits of v and ξ, less what these are without any c, are those of the responses.
    control_lower = stages.lower - free_controls
    control_upper = stages.upper - free_controls
    state_lower = np.tile(stages.state_lower, horizon) - free_states
    state_upper = np.tile(stages.state_upper, horizon) - free_states
    fixed = stages.lower == stages.upper
    kinds_of_controls = fixed * DAQP_FIXED
    kinds_of_states = np.full(n_soft, DAQP_SOFT)
    c, multipliers = _solve_daqp(
        hessian,
        gradient,
        rows=np.vstack([responses.controls, responses.states]),
        lower=np.concatenate([control_lower, state_lower]),
        upper=np.concatenate([control_upper, state_upper]),
        sense=np.concatenate([kinds_of_controls, kinds_of_states]),
        w=stages.w,
        W=stages.W,
    )
    v = responses.controls @ c + free_controls
    nu = multipliers[:n_controls]
    lam = multipliers[n_controls:]
    return QpSolution(v, nu, lam)


@dataclass(frozen=True)
class _Responses:
    """Controls v_0 … v_{N−1} and states ξ_1 … ξ_N: how they respond to c, and without any c.

    Attributes:
        controls: (Nm, Nm).
        states: (Nn, Nm).
        free_controls: (Nm,).
        free_states: (Nn,).
    """

    controls: Matrix
    states: Matrix
    free_controls: Vector
    free_states: Vector


def _simulate_responses(
    stages: Stages,
    feedback: _Feedback,
    xi_0: Vector,
) -> _Responses:
    """Simulate v_k = K_k ξ_k + c_k from ξ_0, for each entry of c and for none."""
    horizon, n, m = stages.B.shape
    n_controls = horizon * m
    controls = np.empty((horizon, m, n_controls))
    states = np.empty((horizon, n, n_controls))
    free_controls = np.empty((horizon, m))
    free_states = np.empty((horizon, n))
    # ξ_0 is given: no c moves it.
    to_c = np.zeros((n, n_controls))
    free = xi_0
    for k in range(horizon):
        A = stages.A[k]
        B = stages.B[k]
        K = feedback.K[k]
        own = slice(k * m, (k + 1) * m)
        controls[k] = K @ to_c
        controls[k, :, own] += np.eye(m)
        free_controls[k] = K @ free
        r = stages.r[k]
        to_c = A @ to_c + B @ controls[k]
        free = A @ free + B @ free_controls[k] + r
        states[k] = to_c
        free_states[k] = free
    return _Responses(
        controls=controls.reshape(n_controls, -1),
        states=states.reshape(horizon * n, -1),
        free_controls=free_controls.reshape(-1),
        free_states=free_states.reshape(-1),
    )


def _solve_daqp(
    hessian: Matrix,
    gradient: Vector,
    *,
    rows: Matrix,
    lower: Vector,
    upper: Vector,
    sense: NDArray[np.int_],
    w: Vector,
    W: Vector,
) -> tuple[Vector, Vector]:
    """Variables and the multipliers of the rows, of which the last are soft; raises QpError."""
    model = daqp.Model()
    model.settings = DAQP_SETTINGS
    kinds = sense.astype(np.int32)
    flag, _ = model.setup(hessian, gradient, rows, upper, lower, kinds)
    if flag >= 0:
        # A soft row has a linear price and the compliance 1/(2W); of the hard rows, which come
        # first, the weights are not read.
        n_hard = len(rows) - w.size
        unused = np.ones(n_hard)
        linear = np.concatenate([unused, w])
        compliance = np.concatenate([unused, 0.5 / W])
        model.soft_weights(
            rho_l=compliance,
            rho_u=compliance,
            w_l=linear,
            w_u=linear,
        )
        c, _, flag, info = model.solve()
    if flag <= 0:
        status = DAQP_STATUS.get(flag, f"exit flag {flag}")
        raise QpError(f"DAQP did not solve the stabilised QP: {status}", status=status)
    return c, info["lam"]
