"""The preparation phase in CasADi: linearise along the guess and condense to the QP of a sample.

Everything is written in deviations from the reference, ξ = x − x_s and v = u − u_s, so that the
costs of paper.tex, Simulations are plain quadratic forms of w = (ξ, v).
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.buffered import StackedFunction, stacked
from controllers.dynamics import stage_function, stage_linearisation
from controllers.problem import Problem
from controllers.qp import SoftQp, Stages
from controllers.theta import ThetaBlocks


def preparation(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """Linearise and condense: all of the QP that does not depend on the state s.

    With V = (v_0, …, v_{N−1}) the predicted states are Ξ = Γ V + Φ ξ_0 + g, and the cost is
    ½VᵀHV + (f + F ξ_0)ᵀV + const. for stage costs ½wᵀL_k w + q_kᵀw and terminal ½ξᵀL_N ξ + q_Nᵀξ.

    Inputs: x (n, N) and u (m, N), the linearisation points; L (n+m, N(n+m)), q (n+m, N),
    L_N (n, n), q_N (n); theta. Results: A, B, r by stage; H, Γ by rows; Φ, g, f, F.

    Two sweeps of N calls each make it, in O(N²) operations: the forward one carries the responses
    of ξ_k to every control, to ξ_0 and to the offsets, the backward one turns them into columns of
    the Hessian. Controls are ordered by age, v_{k−1} first, so that all stages are alike.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    width = horizon * m
    given = {
        "x": ca.MX.sym("x", n, horizon),
        "u": ca.MX.sym("u", m, horizon),
        "L": ca.MX.sym("L", n + m, horizon * (n + m)),
        "q": ca.MX.sym("q", n + m, horizon),
        "L_N": ca.MX.sym("L_N", n, n),
        "q_N": ca.MX.sym("q_N", n),
        "theta": ca.MX.sym("theta", blocks.size),
    }
    A, B, r = stage_linearisation(problem, blocks).map(horizon)(
        given["x"], given["u"], ca.repmat(given["theta"], 1, horizon)
    )
    by_state, by_action, offset = ca.horzsplit(A, n), ca.horzsplit(B, n), ca.horzsplit(r, 1)
    weights, gradients = ca.horzsplit(given["L"], n + m), ca.horzsplit(given["q"], 1)
    respond, differentiate = _respond(n, m, horizon), _differentiate(n, m, horizon)

    start = np.hstack([np.zeros((n, width)), np.eye(n), np.zeros((n, 1))])
    responses = [ca.MX(ca.DM(ca.Sparsity.dense(*start.shape), start.reshape(-1, order="F")))]
    for k in range(horizon):
        responses.append(respond(by_state[k], by_action[k], offset[k], responses[k]))
    costate = given["L_N"] @ responses[horizon]
    costate = ca.horzcat(costate[:, :-1], costate[:, -1] + given["q_N"])
    rows: list[ca.MX] = []
    for k in reversed(range(horizon)):
        stage = (by_state[k], by_action[k], weights[k], gradients[k])
        row, costate = differentiate(*stage, responses[k], costate)
        rows.insert(0, row)
    row, response = ca.horzcat(*rows), ca.horzcat(*responses[1:])
    free = [following[:, width:] for following in responses[1:]]
    return stacked(
        "preparation",
        given,
        {
            "A": A,
            "B": B,
            "r": r,
            "H": _gathered(row, _hessian_positions(n, m, horizon)),
            "Gamma": _gathered(response, _response_positions(n, m, horizon)).T,
            "Phi": ca.vertcat(*(part[:, :n] for part in free)).T,
            "g": ca.vertcat(*(part[:, n] for part in free)),
            "f": ca.vertcat(*(part[:, -1] for part in rows)),
            "F": ca.vertcat(*(part[:, width:-1] for part in rows)).T,
        },
    )


def _respond(n: int, m: int, horizon: int) -> ca.Function:
    """Responses of ξ_{k+1}, (n, Nm + n + 1), from those of ξ_k: to each control, ξ_0 and offsets.

    Every control grows older by one; the oldest place, which no stage before N fills, is dropped.
    """
    A, B, r = ca.SX.sym("A", n, n), ca.SX.sym("B", m, n), ca.SX.sym("r", n)
    response = ca.SX.sym("response", n, horizon * m + n + 1)
    moved = A.T @ response
    moved[:, -1] += r
    kept = ca.horzcat(moved[:, : (horizon - 1) * m], moved[:, horizon * m :])
    return stage_function(
        "respond",
        {"A": A, "B": B, "r": r, "response": response},
        {"following": ca.horzcat(B.T, kept)},
    )


def _differentiate(n: int, m: int, horizon: int) -> ca.Function:
    """Rows (m, Nm + n + 1) of the cost's gradient in v_k and costates (n, Nm + n + 1) at stage k.

    One for each response to which the costates at stage k + 1 belong; of the controls, v_k is the
    first among them and has no response at stage k.
    """
    A, B = ca.SX.sym("A", n, n), ca.SX.sym("B", m, n)
    L, q = ca.SX.sym("L", n + m, n + m), ca.SX.sym("q", n + m)
    width = horizon * m
    response, costate = (ca.SX.sym(name, n, width + n + 1) for name in ("response", "costate"))
    kept = ca.horzcat(response[:, : width - m], response[:, width:])
    row = L[n:, :n] @ kept + B @ costate[:, m:]
    row[:, -1] += q[n:]
    previous = L[:n, :n] @ kept + A @ costate[:, m:]
    previous[:, -1] += q[:n]
    return stage_function(
        "differentiate",
        {"A": A, "B": B, "L": L, "q": q, "response": response, "costate": costate},
        {
            "row": ca.horzcat(B @ costate[:, :m] + L[n:, n:], row),
            "previous": ca.horzcat(previous[:, : width - m], ca.SX(n, m), previous[:, width - m :]),
        },
    )


def _gathered(source: ca.MX, positions: NDArray[np.int64]) -> ca.MX:
    """Matrix of the source's entries at positions in column-major order; −1 stands for zero."""
    extended = ca.vertcat(ca.vec(source), 0)
    index = np.where(positions < 0, source.numel(), positions)
    return ca.reshape(extended[index.reshape(-1, order="F").tolist()], *positions.shape)


def _hessian_positions(n: int, m: int, horizon: int) -> NDArray[np.int64]:
    """Where H's entries, (Nm, Nm), stand in the rows of all stages; its upper triangle mirrors."""
    first, second = np.indices((horizon * m, horizon * m))
    (k, a), (j, b) = (
        np.divmod(np.maximum(first, second), m),
        np.divmod(np.minimum(first, second), m),
    )
    column: NDArray[np.int64] = k * (horizon * m + n + 1) + (k - j) * m + b
    return column * m + a


def _response_positions(n: int, m: int, horizon: int) -> NDArray[np.int64]:
    """Where Γ's entries, (Nn, Nm), stand in the responses of ξ_1 … ξ_N; −1 above its diagonal."""
    first, second = np.indices((horizon * n, horizon * m))
    (k, i), (j, b) = np.divmod(first, n), np.divmod(second, m)
    column = k * (horizon * m + n + 1) + (k - j) * m + b
    positions: NDArray[np.int64] = np.where(j <= k, column * n + i, -1)
    return positions


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
