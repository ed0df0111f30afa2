"""The feedback phase in CasADi: the state put into the prepared QP, and its solution read out."""

from __future__ import annotations

import casadi as ca

from controllers.functions import StackedFunction
from controllers.problem import Problem
from controllers.theta import SymbolicTheta, ThetaBlocks


def embedding(
    problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction, read: StackedFunction
) -> StackedFunction:
    """Initial value embedding: the vectors of the QP that depend on the state s.

    Inputs: s, read from the read-out's memory; theta and the rest from the preparation's. Results,
    written to the read-out's memory: the gradient f, and the lower and upper limits that the soft
    rows Γ V must respect.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    symbols = SymbolicTheta.of(problem, blocks)
    s = ca.SX.sym("s", n)
    x_s = ca.DM(problem.reference_state)
    prior = {
        "Phi": ca.SX.sym("Phi", n, horizon * n),
        "g": ca.SX.sym("g", horizon * n),
        "f": ca.SX.sym("f", horizon * m),
        "F": ca.SX.sym("F", n, horizon * m),
    }
    free = prior["Phi"].T @ (s - x_s) + prior["g"]
    lower = ca.repmat(symbols["x_l"] - x_s, horizon, 1) - free
    upper = ca.repmat(symbols["x_u"] - x_s, horizon, 1) - free
    return StackedFunction(
        "embedding",
        {"s": s, "theta": symbols.theta, **prior},
        {"f": prior["f"] + prior["F"].T @ (s - x_s), "lower": lower, "upper": upper},
        {name: prepared.stack[prepared.slices[name]] for name in prior}
        | {"theta": prepared.inputs["theta"], "s": read.inputs["s"]},
        memory=read.memory[read.places["f"].start : read.places["row_upper"].stop],
    )


def readout(problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction) -> StackedFunction:
    """States, slack, costates and value that belong to a solution (v, λ) of the condensed QP.

    Inputs: s (n), v (m, N), lam (n, N); the constant of the QP's stage costs; theta and the QP's
    A, B, r, L, q, L_N, q_N are read from the preparation's memory. Results: xi (n, N+1),
    t (n, N), chi (n, N+1), value. The costates χ solve the adjoint recursion, so χ_0 is the
    gradient of the value in s. The solution shifted by one stage is the next point of
    linearisation: next_x (n, N), next_u (m, N) in absolute units, next_chi (n, N), the costates of
    stages that weigh 1/γ as much. Behind them its memory has room for the rest of a solution: what
    `embedding` gives, multipliers nu of the controls' limits `lower` and `upper` (Nm,), and what
    compiled code gives, `residual` and `iterations` of the QP's solver and the gradient (n_θ,).
    """
    n, m, horizon, gamma = problem.n_states, problem.n_actions, problem.horizon, problem.discount
    symbols = SymbolicTheta.of(problem, blocks)
    x_s = ca.DM(problem.reference_state)
    shapes = {
        "s": (n, 1),
        "v": (m, horizon),
        "lam": (n, horizon),
        "A": (n, n * horizon),
        "B": (m, n * horizon),
        "r": (n, horizon),
        "L": (n + m, horizon * (n + m)),
        "q": (n + m, horizon),
        "L_N": (n, n),
        "q_N": (n, 1),
        "constant": (1, 1),
    }
    given = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
    s, v, lam, A, B, r, L, q, L_N, q_N, constant = given.values()

    known = problem.symbolic_penalty(s)
    xi = [s - x_s]
    value = constant + known + symbols["c_lambda"]
    value += ca.bilin(symbols["B_lambda"], xi[0]) + ca.dot(symbols["b_lambda"], xi[0])
    t, weights = [], []
    for k in range(horizon):
        w = ca.vertcat(xi[k], v[:, k])
        weights.append(L[:, k * (n + m) : (k + 1) * (n + m)])
        value += ca.bilin(weights[k], w) / 2 + ca.dot(q[:, k], w)
        columns = slice(k * n, (k + 1) * n)
        xi.append(A[:, columns].T @ xi[k] + B[:, columns].T @ v[:, k] + r[:, k])
        outside = ca.fmax(symbols["x_l"] - x_s - xi[k + 1], xi[k + 1] - symbols["x_u"] + x_s)
        t.append(ca.fmax(outside, 0))
        value += gamma ** (k + 1) * (
            ca.dot(symbols["w_sigma"], t[k]) + ca.dot(symbols["W_sigma"], t[k] ** 2)
        )
    value += ca.bilin(L_N, xi[horizon]) / 2 + ca.dot(q_N, xi[horizon])

    chi = [L_N @ xi[horizon] + q_N + lam[:, horizon - 1]]
    for k in reversed(range(horizon)):
        w = ca.vertcat(xi[k], v[:, k])
        costate = weights[k][:n, :] @ w + q[:n, k] + A[:, k * n : (k + 1) * n] @ chi[0]
        if k == 0:
            costate += 2 * symbols["B_lambda"] @ xi[0] + symbols["b_lambda"]
            costate += ca.gradient(known, s)
        else:
            costate += lam[:, k - 1]
        chi.insert(0, costate)
    u_s = ca.DM(problem.reference_action)
    return StackedFunction(
        "readout",
        {**given, "theta": symbols.theta},
        {
            "xi": ca.horzcat(*xi),
            "t": ca.horzcat(*t),
            "chi": ca.horzcat(*chi),
            "value": value,
            "next_x": ca.horzcat(*(state + x_s for state in xi[1:])),
            "next_u": ca.horzcat(v[:, 1:], v[:, -1]) + ca.repmat(u_s, 1, horizon),
            "next_chi": ca.horzcat(*(costate / gamma for costate in chi[2:]), chi[-1]),
        },
        {name: prepared.stack[prepared.slices[name]] for name in ("A", "B", "r")}
        | {name: prepared.inputs[name] for name in ("L", "q", "L_N", "q_N", "theta")},
        room=dict.fromkeys(("f", "row_lower", "row_upper", "nu", "lower", "upper"), horizon * m)
        | dict.fromkeys(("row_lower", "row_upper"), horizon * n)
        | {"residual": 1, "iterations": 1, "gradient": blocks.size},
    )
