"""The parametric OCP in CasADi: linearised dynamics, condensed QP data and the QP's Lagrangian.

Everything is written in deviations from the reference, ξ = x − x_s and v = u − u_s, so that the
costs of paper.tex, Simulations are plain quadratic forms of w = (ξ, v).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from controllers.buffered import StackedFunction, stacked
from controllers.layout import Layout
from controllers.problem import Problem
from controllers.qp import SoftQp, Stages


def symmetric(packed: ca.SX, dimension: int) -> ca.SX:
    """Symmetric matrix from its upper triangle, row by row."""
    matrix = ca.SX(dimension, dimension)
    position = 0
    for i in range(dimension):
        for j in range(i, dimension):
            matrix[i, j] = matrix[j, i] = packed[position]
            position += 1
    return matrix


@dataclass(frozen=True)
class SymbolicParameters:
    """θ as one symbol and its blocks, with the problem's constants where θ has no block."""

    theta: ca.SX
    blocks: dict[str, ca.SX]
    model_parameters: ca.SX

    @classmethod
    def of(cls, problem: Problem, layout: Layout) -> SymbolicParameters:
        """Symbols for a layout of θ."""
        theta = ca.SX.sym("theta", layout.size)
        blocks = {}
        for block in layout.blocks:
            part = theta[layout.slices[block.name]]
            blocks[block.name] = symmetric(part, block.dimension) if block.symmetric else part
        blocks.setdefault("w_sigma", ca.SX(ca.DM(problem.penalty_linear)))
        blocks.setdefault("W_sigma", ca.SX(ca.DM(problem.penalty_quadratic)))
        parameters = ca.SX(ca.DM(problem.model.nominal_parameters))
        if "p" in layout:
            for i, index in enumerate(problem.model.parameter_indices(layout.block("p").labels)):
                parameters[index] = blocks["p"][i]
        return cls(theta, blocks, parameters)


def sampled_jacobian(
    problem: Problem, x: ca.SX, u: ca.SX, parameters: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """State after one sample of the nominal model, and its Jacobian with respect to (x, u).

    The variational equation goes through the same RK4 steps as the state, so the Jacobian is that
    of the discrete map itself, at fewer operations than differentiating the map.
    """
    n, m, model = problem.n_states, problem.n_actions, problem.model
    free = ca.symvar(parameters)
    at, held = ca.SX.sym("at", n), ca.SX.sym("held", m)
    rate = model.ode(at, held, ca.SX(ca.DM(model.nominal_disturbance)), parameters)
    slope = ca.Function(
        "slope", [at, held, *free], [rate, ca.jacobian(rate, at), ca.jacobian(rate, held)]
    )
    h = problem.sampling_time / model.time_unit / problem.substeps

    def stage(point: ca.SX, sensitivity: ca.SX) -> tuple[ca.SX, ca.SX]:
        value, by_state, by_action = slope(point, u, *free)
        return value, by_state @ sensitivity + ca.horzcat(ca.SX(n, n), by_action)

    drift = ca.horzcat(ca.SX.eye(n), ca.SX(n, m))
    for _ in range(problem.substeps):
        k1, s1 = stage(x, drift)
        k2, s2 = stage(x + h / 2 * k1, drift + h / 2 * s1)
        k3, s3 = stage(x + h / 2 * k2, drift + h / 2 * s2)
        k4, s4 = stage(x + h * k3, drift + h * s3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        drift = drift + h / 6 * (s1 + 2 * s2 + 2 * s3 + s4)
    return x, drift


def linearisation(
    problem: Problem, symbols: SymbolicParameters, x: ca.SX, u: ca.SX
) -> tuple[list[ca.SX], list[ca.SX], list[ca.SX]]:
    """Matrices A_k, B_k and offsets r_k of ξ₊ = A_k ξ + B_k v + r_k along the points x, u.

    x has shape (n, N), u (m, N), in absolute units; r_k holds the model offset c_f too.
    """
    n = problem.n_states
    x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
    by_state, by_action, offset = [], [], []
    for k in range(problem.horizon):
        x_next, jacobian = sampled_jacobian(problem, x[:, k], u[:, k], symbols.model_parameters)
        a, b = jacobian[:, :n], jacobian[:, n:]
        by_state.append(a)
        by_action.append(b)
        offset.append(
            x_next - x_s - a @ (x[:, k] - x_s) - b @ (u[:, k] - u_s) + symbols.blocks["c_f"]
        )
    return by_state, by_action, offset


def preparation(problem: Problem, layout: Layout) -> StackedFunction:
    """Linearise and condense: all of the QP that does not depend on the state s.

    With V = (v_0, …, v_{N−1}) the predicted states are Ξ = Γ V + Φ ξ_0 + g, and the cost is
    ½VᵀHV + (f + F ξ_0)ᵀV + const. for stage costs ½wᵀL_k w + q_kᵀw and terminal ½ξᵀL_N ξ + q_Nᵀξ.

    Inputs: x (n, N) and u (m, N), the linearisation points; L (n+m, N(n+m)), q (n+m, N),
    L_N (n, n), q_N (n); theta. Results: A, B, r by stage; H, Γ by rows; Φ, g, f, F.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    symbols = SymbolicParameters.of(problem, layout)
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


def embedding(problem: Problem, layout: Layout, prepared: StackedFunction) -> StackedFunction:
    """Initial value embedding: the vectors of the QP that depend on the state s.

    Inputs: s; theta; the rest is read from the preparation's memory. Results: the gradient f, and
    the lower and upper limits that the soft rows Γ V must respect.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    symbols = SymbolicParameters.of(problem, layout)
    s = ca.SX.sym("s", n)
    x_s = ca.DM(problem.reference_state)
    prior = {
        "Phi": ca.SX.sym("Phi", n, horizon * n),
        "g": ca.SX.sym("g", horizon * n),
        "f": ca.SX.sym("f", horizon * m),
        "F": ca.SX.sym("F", n, horizon * m),
    }
    free = prior["Phi"].T @ (s - x_s) + prior["g"]
    lower = ca.repmat(symbols.blocks["x_l"] - x_s, horizon, 1) - free
    upper = ca.repmat(symbols.blocks["x_u"] - x_s, horizon, 1) - free
    return stacked(
        "embedding",
        {"s": s, "theta": symbols.theta, **prior},
        {"f": prior["f"] + prior["F"].T @ (s - x_s), "lower": lower, "upper": upper},
        {name: prepared.stack[prepared.slices[name]] for name in prior},
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
