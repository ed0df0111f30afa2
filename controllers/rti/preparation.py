"""The preparation phase in CasADi: linearise along the guess and condense to the QP of a sample.

Everything is written in deviations from the reference, ξ = x − x_s and v = u − u_s, so that the
costs of paper.tex, Simulations are plain quadratic forms of w = (ξ, v).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from controllers.buffered import StackedFunction, stacked
from controllers.dynamics import linearisation
from controllers.problem import Problem
from controllers.qp import SoftQp, Stages
from controllers.theta import SymbolicTheta, ThetaBlocks


def preparation(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """Linearise and condense: all of the QP that does not depend on the state s.

    With V = (v_0, …, v_{N−1}) the predicted states are Ξ = Γ V + Φ ξ_0 + g, and the cost is
    ½VᵀHV + (f + F ξ_0)ᵀV + const. for stage costs ½wᵀL_k w + q_kᵀw and terminal ½ξᵀL_N ξ + q_Nᵀξ.

    Inputs: x (n, N) and u (m, N), the linearisation points; L (n+m, N(n+m)), q (n+m, N),
    L_N (n, n), q_N (n); theta. Results: A, B, r by stage; H, Γ by rows; Φ, g, f, F.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    symbols = SymbolicTheta.of(problem, blocks)
    x, u = ca.SX.sym("x", n, horizon), ca.SX.sym("u", m, horizon)
    quadratic = ca.SX.sym("L", n + m, horizon * (n + m))
    linear = ca.SX.sym("q", n + m, horizon)
    quadratic_end, linear_end = ca.SX.sym("L_N", n, n), ca.SX.sym("q_N", n)
    by_state, by_action, offset = linearisation(problem, symbols, x, u)

    # Column blocks: each control, then the initial state, then the offset; a column is the
    # response of ξ_k to it, and the adjoint sweep below turns it into a column of the Hessian.
    columns = [[ca.SX(n, m)] * (horizon + 1) for _ in range(horizon)]
    for j, column in enumerate(columns):
        column[j + 1] = by_action[j]
        for k in range(j + 1, horizon):
            column[k + 1] = by_state[k] @ column[k]
    initial, drift = [ca.SX.eye(n)], [ca.SX(n, 1)]
    for k in range(horizon):
        initial.append(by_state[k] @ initial[k])
        drift.append(by_state[k] @ drift[k] + offset[k])

    def block(k: int, rows: slice, cols: slice) -> ca.SX:
        return quadratic[:, k * (n + m) : (k + 1) * (n + m)][rows, cols]

    of_x, of_u = slice(0, n), slice(n, n + m)

    def adjoint(response: list[ca.SX], first: int, own: int | None, affine: bool) -> list[ca.SX]:
        """Gradient blocks of the cost, from stage `first` on, along a state response."""
        gradient: list[ca.SX] = []
        costate = quadratic_end @ response[horizon] + (linear_end if affine else 0)
        for k in reversed(range(first, horizon)):
            row = block(k, of_u, of_x) @ response[k] + by_action[k].T @ costate
            row = row + (linear[n:, k] if affine else 0)
            gradient.insert(0, row + (block(k, of_u, of_u) if own == k else 0))
            costate = block(k, of_x, of_x) @ response[k] + by_state[k].T @ costate
            costate = costate + (linear[:n, k] if affine else 0)
            if own == k:
                costate = costate + block(k, of_x, of_u)
        return gradient

    hessian = ca.SX(horizon * m, horizon * m)
    for j, column in enumerate(columns):
        rows = ca.vertcat(*adjoint(column, j, j, affine=False))
        hessian[j * m :, j * m : (j + 1) * m] = rows
    hessian = ca.tril2symm(ca.tril(hessian))
    response = ca.vertcat(
        *(ca.horzcat(*(column[k] for column in columns)) for k in range(1, horizon + 1))
    )
    return stacked(
        "preparation",
        {
            "x": x,
            "u": u,
            "L": quadratic,
            "q": linear,
            "L_N": quadratic_end,
            "q_N": linear_end,
            "theta": symbols.theta,
        },
        {
            "A": ca.horzcat(*(matrix.T for matrix in by_state)),
            "B": ca.horzcat(*(matrix.T for matrix in by_action)),
            "r": ca.horzcat(*offset),
            "H": hessian,
            "Gamma": response.T,
            "Phi": ca.vertcat(*initial[1:]).T,
            "g": ca.vertcat(*drift[1:]),
            "f": ca.vertcat(*adjoint(drift, 0, None, affine=True)),
            "F": ca.vertcat(*adjoint(initial, 0, None, affine=False)).T,
        },
    )


def qp_in_memory(
    problem: Problem, prepared: StackedFunction, embedded: StackedFunction
) -> tuple[SoftQp, Stages]:
    """The QP whose data are the memory of the preparation and the embedding, and its stages.

    Calling the two functions rewrites it in place. The inputs' bounds and the sizes stand; the
    initial state, the state's bounds and the slack weights are the caller's to write.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    stages = Stages(
        A=prepared.part("A").reshape(horizon, n, n),
        B=prepared.part("B").reshape(horizon, n, m),
        r=prepared.part("r"),
        L=prepared.inputs["L"].reshape(horizon, n + m, n + m),
        q=prepared.inputs["q"].reshape(horizon, n + m),
        L_N=prepared.inputs["L_N"].reshape(n, n),
        q_N=prepared.inputs["q_N"],
        initial=np.zeros(n),
        state_lower=np.zeros(n),
        state_upper=np.zeros(n),
    )
    qp = SoftQp(
        H=prepared.part("H"),
        f=embedded.part("f"),
        lower=np.tile(problem.action_lower - problem.reference_action, horizon),
        upper=np.tile(problem.action_upper - problem.reference_action, horizon),
        rows=prepared.part("Gamma"),
        row_lower=embedded.part("lower"),
        row_upper=embedded.part("upper"),
        w=np.zeros(n * horizon),
        W=np.zeros(n * horizon),
        stages=stages,
    )
    return qp, stages
