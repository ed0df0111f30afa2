"""A change of variables that makes the condensed Hessian the identity, by a Riccati recursion.

A QP solver's own factorisation of H and its rows in the new variables cost O(N³), these O(N²):
from about N = 40 on that is the larger part of a preparation.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.buffered import StackedFunction, stacked
from controllers.dynamics import stage_function
from controllers.problem import Problem

LEAST_CONTROLS = 60
"""Number of controls N·m from which the recursion is cheaper than a dense factorisation."""


def riccati(problem: Problem, prepared: StackedFunction) -> StackedFunction:
    """T with TᵀHT = I, and ΓT, for the H and Γ that `prepared`, the preparation, has condensed.

    With P_N = L_N, R̃_k = R_k + B_kᵀ P₊ B_k = U_kᵀ U_k and K_k = −R̃_k⁻¹ (S_k + B_kᵀ P₊ A_k), where
    P₊ is P_{k+1}, the cost of the deviations is ½ ξ_0ᵀ P_0 ξ_0 + ½ Σ ‖y_k‖² in the variables
    v_k = K_k ξ_k + U_k⁻¹ y_k (stage costs ½wᵀL_k w with L_k = [Q_k, S_kᵀ; S_k, R_k]). From ξ_0 = 0
    that is v = T y, a triangle of blocks, and ξ = Γ T y. Result `limits` (Nm + Nn, Nm): by rows T,
    then ΓT. Where H is not positive definite, some R̃_k is not either, and the first row of T is not
    finite.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    shapes = {"A": (n, n), "B": (m, n), "L": (n + m, n + m)}
    given = {name: ca.MX.sym(name, r, c * horizon) for name, (r, c) in shapes.items()}
    given["L_N"] = ca.MX.sym("L_N", n, n)
    stages = [
        dict(zip(shapes, parts, strict=True))
        for parts in zip(
            *(ca.horzsplit(given[name], columns) for name, (_, columns) in shapes.items()),
            strict=True,
        )
    ]
    backwards = _backwards(n, m)
    P = given["L_N"]
    gains: list[tuple[ca.MX, ...]] = []
    for stage in reversed(stages):
        *gain, P = backwards(stage["A"], stage["B"], stage["L"], P)
        gains.insert(0, tuple(gain))
    # By columns: each of the transposed rows is one of the result's columns.
    response, actions, states = ca.MX(n, 0), [], []
    for k, (feedback, scale, closed, driven) in enumerate(gains):
        later = (horizon - 1 - k) * m
        actions.append(_rows(ca.horzcat(feedback @ response, scale), later))
        response = ca.horzcat(closed @ response, driven)
        states.append(_rows(response, later))
    shared = {name: prepared.stack[prepared.slices[name]] for name in ("A", "B")}
    shared |= {name: prepared.inputs[name] for name in ("L", "L_N")}
    return stacked("riccati", given, {"limits": ca.horzcat(*actions, *states)}, shared)


def limits_of(function: StackedFunction) -> NDArray[np.float64]:
    """[T; ΓT], (Nm + Nn, Nm), of what the preparation holds now; the function's own memory."""
    function()
    return function.part("limits")


def _rows(block: ca.MX, later: int) -> ca.MX:
    """The block's rows as columns, with zeros for the `later` variables."""
    return ca.vertcat(block.T, ca.MX(later, block.shape[0]))


def _backwards(n: int, m: int) -> ca.Function:
    """One stage: K, U⁻¹, A + B K, B U⁻¹ and P from A_kᵀ, B_kᵀ, L_k and the P of the next stage."""
    A, B = ca.SX.sym("A", n, n), ca.SX.sym("B", m, n)
    L, following = ca.SX.sym("L", n + m, n + m), ca.SX.sym("following", n, n)
    weighted = B @ following
    U = ca.chol(L[n:, n:] + weighted @ B.T)
    scale = ca.solve(U, ca.SX(ca.DM(np.eye(m))))
    cross = L[n:, :n] + weighted @ A.T
    feedback = -scale @ (scale.T @ cross)
    closed, driven = A.T + B.T @ feedback, B.T @ scale
    P = L[:n, :n] + A @ following @ A.T + cross.T @ feedback
    return stage_function(
        "backwards",
        {"A": A, "B": B, "L": L, "following": following},
        {"K": feedback, "scale": scale, "closed": closed, "driven": driven, "P": (P + P.T) / 2},
    )
