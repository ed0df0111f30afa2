"""A sample in CasADi: linearise and condense to a QP, put the state in, read the solution out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ControllerError
from controllers.functions import StackedFunction
from controllers.integration import check_integration
from controllers.model import runge_kutta
from controllers.problem import Problem
from controllers.qp import LEAST_SIZE, SoftQp
from controllers.theta import Parameters, Symbols, ThetaBlocks, symbolic_theta
from cosim.core.protocols import Vector
from cosim.core.validation import instead

SOLVED_RESIDUAL = 1e-8
"""Largest KKT residual of a QP that counts as solved."""


def sampled_jacobian(
    problem: Problem, x: ca.SX, u: ca.SX, parameters: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """State after one sample of the nominal model, and its Jacobian with respect to (x, u).

    The variational equation goes through the same RK4 steps as the state, so the Jacobian is that
    of the discrete map itself, at fewer operations than differentiating the map.

    Args:
        problem: The problem, whose model is integrated over one sample in its `substeps`.
        x: State at the sample's start in the model's units, (n,).
        u: Action held over the sample, (m,).
        parameters: Physical parameters of the model, (n_p,).

    Returns:
        The state after the sample (n,), and its Jacobian (n, n+m).
    """
    n = problem.n_states
    m = problem.n_actions
    model = problem.model

    # One function of the rate and its derivatives, called at each of the four points of a step.
    free = ca.symvar(parameters)
    state = ca.SX.sym("at", n)
    action = ca.SX.sym("held", m)
    disturbance = ca.SX(ca.DM(model.nominal_disturbance))
    rate = model.ode(state, action, disturbance, parameters)
    slopes = [ca.jacobian(rate, state), ca.jacobian(rate, action)]
    evaluate = ca.Function("slope", [state, action, *free], [rate, *slopes])

    def rate_and_variation(columns: ca.SX) -> ca.SX:
        """d/dt of (x, ∂x/∂(x, u)), whose columns are side by side."""
        value, by_state, by_action = evaluate(columns[:, 0], u, *free)
        variation = by_state @ columns[:, 1:] + ca.horzcat(ca.SX(n, n), by_action)
        return ca.horzcat(value, variation)

    step = problem.sampling_time / model.time_unit / problem.substeps
    start = ca.horzcat(x, ca.SX.eye(n), ca.SX(n, m))
    end = runge_kutta(rate_and_variation, start, step, problem.substeps)
    return end[:, 0], end[:, 1:]


def stage_linearisation(problem: Problem, blocks: ThetaBlocks) -> ca.Function:
    """One stage's A_k, B_k and r_k of ξ₊ = A_k ξ + B_k v + r_k (paper.tex eq. param_nlp_qp).

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.

    Returns:
        Function of x (n,) and u (m,) in the model's units and theta. Its results are A_kᵀ (n, n),
        B_kᵀ (m, n) and r_k (n,), which holds the model offset c_f too, for ξ and v in units of
        `Problem.scale`.
    """
    n = problem.n_states
    scale = problem.scale
    x, u, symbols = _linearisation_symbols(problem, blocks)
    x_s = ca.DM(problem.reference_state)
    u_s = ca.DM(problem.reference_action)

    x_next, jacobian = sampled_jacobian(problem, x, u, symbols["model_parameters"])
    A = jacobian[:, :n]
    B = jacobian[:, n:]
    offset = x_next - x_s - A @ (x - x_s) - B @ (u - u_s) + symbols["c_f"]

    state_units = ca.DM(np.outer(1 / scale.state, scale.state))
    action_units = ca.DM(np.outer(1 / scale.state, scale.action))
    arguments = {"x": x, "u": u, "theta": symbols["theta"]}
    results = {
        "A": (A * state_units).T,
        "B": (B * action_units).T,
        "r": offset / ca.DM(scale.state),
    }
    return stage_function("linearise", arguments, results)


def stage_parameter_gradient(problem: Problem, blocks: ThetaBlocks, *, exact: bool) -> ca.Function:
    """One stage's ∇_p of the QP's Lagrangian in the model parameters p that θ holds.

    That is ∇_p [χᵀ(f + J Δw) + ⟨M, D⟩] with f and its Jacobian J at (x, u) and the step
    Δw = w − (x, u) to the QP's solution. With `exact`, D is the curvature of χ̄ᵀf under weights M.
    The multipliers are contracted before anything is differentiated, so that one tangent goes
    through the model in place of n + m.

    Args:
        problem: The problem with its model.
        blocks: The blocks of θ, one of which is p.
        exact: Whether the QP's Hessian holds the curvature of the model.

    Returns:
        Function of x (n,), u (m,), theta, w (n+m,) in the model's units, chi (n,) and, with
        `exact`, M (n+m, n+m) and guess (n,), which is χ̄; its result is `gradient` (n_p,).
    """
    n = problem.n_states
    m = problem.n_actions
    x, u, symbols = _linearisation_symbols(problem, blocks)
    w = ca.SX.sym("w", n + m)
    chi = ca.SX.sym("chi", n)
    arguments = {"x": x, "u": u, "theta": symbols["theta"], "w": w, "chi": chi}

    x_next, _ = sampled_jacobian(problem, x, u, symbols["model_parameters"])
    point = ca.vertcat(x, u)
    lagrangian = ca.dot(chi, x_next + ca.jtimes(x_next, point, w - point))
    if exact:
        M = ca.SX.sym("M", n + m, n + m)
        guess = ca.SX.sym("guess", n)
        lagrangian += ca.dot(M, _curvature(problem, symbols, x, u, guess))
        arguments |= {"M": M, "guess": guess}
    # By θ and not by p alone: p's symbols are entries of θ's.
    gradient = ca.gradient(lagrangian, symbols["theta"])[blocks.slices["p"]]
    return stage_function("parameter_gradient", arguments, {"gradient": gradient})


def stage_function(
    name: str, arguments: Mapping[str, ca.SX], results: Mapping[str, ca.SX]
) -> ca.Function:
    """Function of one stage, to be mapped over the horizon: dense, common expressions shared.

    Args:
        name: Name of the function, in C too.
        arguments: Its symbols by the names of its inputs.
        results: Its expressions by the names of its outputs.
    """
    return ca.Function(
        name,
        [ca.densify(argument) for argument in arguments.values()],
        [ca.densify(result) for result in results.values()],
        list(arguments),
        list(results),
        {"cse": True},
    )


def _linearisation_symbols(problem: Problem, blocks: ThetaBlocks) -> tuple[ca.SX, ca.SX, Symbols]:
    """Symbols of a stage's state (n,) and action (m,), and those of θ."""
    x = ca.SX.sym("x", problem.n_states)
    u = ca.SX.sym("u", problem.n_actions)
    return x, u, symbolic_theta(problem, blocks)


def _curvature(problem: Problem, symbols: Symbols, x: ca.SX, u: ca.SX, chi: ca.SX) -> ca.SX:
    """D = ∇²_(x,u) χᵀf(x, u), (n+m, n+m), of the sampled model f."""
    x_next, _ = sampled_jacobian(problem, x, u, symbols["model_parameters"])
    hessian, _ = ca.hessian(ca.dot(chi, x_next), ca.vertcat(x, u))
    return hessian


def preparation(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """Linearise and condense: all of the QP that does not depend on the state s.

    All of the QP is in units of `Problem.scale`: states ξ, actions v and costs.
    With V = (v_0, …, v_{N−1}) the predicted states are Ξ = Γ V + Φ ξ_0 + g, and the cost is
    ½VᵀHV + (f + F ξ_0)ᵀV + const. for stage costs ½wᵀL_k w + q_kᵀw and terminal ½ξᵀL_N ξ + q_Nᵀξ.

    Two sweeps of N calls each make it, in O(N²) operations: the forward one carries the responses
    of ξ_k to every control, to ξ_0 and to the offsets, the backward one turns them into columns of
    the Hessian. Controls are ordered by age, v_{k−1} first, so that all stages are alike.

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.

    Returns:
        Function of x (n, N) and u (m, N), the linearisation points; L (n+m, N(n+m)), q (n+m, N),
        L_N (n, n), q_N (n); theta. Its results are A, B, r by stage; H, Γ by rows; Φ, g, f, F.
        Behind them its memory has room for the rest of the QP: the costates (N, n) of the
        linearisation point, the discounted slack weights w and W (Nn,), and the constant of the
        stage costs.
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    width = horizon * m
    arguments = {
        "x": ca.MX.sym("x", n, horizon),
        "u": ca.MX.sym("u", m, horizon),
        "L": ca.MX.sym("L", n + m, horizon * (n + m)),
        "q": ca.MX.sym("q", n + m, horizon),
        "L_N": ca.MX.sym("L_N", n, n),
        "q_N": ca.MX.sym("q_N", n),
        "theta": ca.MX.sym("theta", blocks.size),
    }
    theta = ca.repmat(arguments["theta"], 1, horizon)
    linearise = stage_linearisation(problem, blocks).map(horizon)
    A, B, r = linearise(arguments["x"], arguments["u"], theta)
    A_k = ca.horzsplit(A, n)
    B_k = ca.horzsplit(B, n)
    r_k = ca.horzsplit(r, 1)
    L_k = ca.horzsplit(arguments["L"], n + m)
    q_k = ca.horzsplit(arguments["q"], 1)

    # Forward: ξ_0 responds to itself alone.
    respond = _respond(n, m, horizon)
    start = np.hstack([np.zeros((n, width)), np.eye(n), np.zeros((n, 1))])
    dense = ca.Sparsity.dense(*start.shape)
    responses = [ca.MX(ca.DM(dense, start.reshape(-1, order="F")))]
    for k in range(horizon):
        responses.append(respond(A_k[k], B_k[k], r_k[k], responses[k]))

    # Backward: the costates' responses, from those of the terminal cost's gradient on.
    differentiate = _differentiate(n, m, horizon)
    costate = arguments["L_N"] @ responses[horizon]
    costate = ca.horzcat(costate[:, :-1], costate[:, -1] + arguments["q_N"])
    rows: list[ca.MX] = []
    for k in reversed(range(horizon)):
        row, costate = differentiate(A_k[k], B_k[k], L_k[k], q_k[k], responses[k], costate)
        rows.insert(0, row)

    # Columns behind those of the controls belong to ξ_0, the last one to the offsets.
    by_start = [response[:, width:] for response in responses[1:]]
    hessian = _gather(ca.horzcat(*rows), _hessian_positions(n, m, horizon))
    gamma = _gather(ca.horzcat(*responses[1:]), _response_positions(n, m, horizon))
    results = {
        "A": A,
        "B": B,
        "r": r,
        "H": hessian,
        "Gamma": gamma.T,
        "Phi": ca.vertcat(*(response[:, :n] for response in by_start)).T,
        "g": ca.vertcat(*(response[:, n] for response in by_start)),
        "f": ca.vertcat(*(row[:, -1] for row in rows)),
        "F": ca.vertcat(*(row[:, width:-1] for row in rows)).T,
    }
    room = {
        "costates": horizon * n,
        "w": horizon * n,
        "W": horizon * n,
        "constant": 1,
    }
    return StackedFunction("preparation", arguments, results, room=room)


def _respond(n: int, m: int, horizon: int) -> ca.Function:
    """Responses (n, Nm + n + 1) of ξ_{k+1} from those of ξ_k: to each control, ξ_0 and offsets."""
    width = horizon * m
    A = ca.SX.sym("A", n, n)
    B = ca.SX.sym("B", m, n)
    r = ca.SX.sym("r", n)
    response = ca.SX.sym("response", n, width + n + 1)

    following = A.T @ response
    following[:, -1] += r
    # Every control is one sample older; the oldest columns, of controls yet to come, are zero.
    older = ca.horzcat(following[:, : width - m], following[:, width:])
    arguments = {"A": A, "B": B, "r": r, "response": response}
    return stage_function("respond", arguments, {"following": ca.horzcat(B.T, older)})


def _differentiate(n: int, m: int, horizon: int) -> ca.Function:
    """Rows (m, Nm + n + 1) of the gradient in v_k and costates (n, Nm + n + 1) at stage k."""
    width = horizon * m
    A = ca.SX.sym("A", n, n)
    B = ca.SX.sym("B", m, n)
    L = ca.SX.sym("L", n + m, n + m)
    q = ca.SX.sym("q", n + m)
    response = ca.SX.sym("response", n, width + n + 1)
    costate = ca.SX.sym("costate", n, width + n + 1)

    # The costate of stage k+1 responds to v_k first, which is one control more than ξ_k does.
    states = ca.horzcat(response[:, : width - m], response[:, width:])
    row = L[n:, :n] @ states + B @ costate[:, m:]
    row[:, -1] += q[n:]
    previous = L[:n, :n] @ states + A @ costate[:, m:]
    previous[:, -1] += q[:n]

    arguments = {
        "A": A,
        "B": B,
        "L": L,
        "q": q,
        "response": response,
        "costate": costate,
    }
    none_yet = ca.SX(n, m)
    results = {
        "row": ca.horzcat(B @ costate[:, :m] + L[n:, n:], row),
        "previous": ca.horzcat(previous[:, : width - m], none_yet, previous[:, width - m :]),
    }
    return stage_function("differentiate", arguments, results)


def _gather(source: ca.MX, positions: NDArray[np.int64]) -> ca.MX:
    """Matrix of the source's entries at positions in column-major order; −1 stands for zero."""
    extended = ca.vertcat(ca.vec(source), 0)
    index = np.where(positions < 0, source.numel(), positions)
    entries = extended[index.reshape(-1, order="F").tolist()]
    return ca.reshape(entries, *positions.shape)


def _hessian_positions(n: int, m: int, horizon: int) -> NDArray[np.int64]:
    """Positions of H's entries, (Nm, Nm), in the rows of all stages; its upper triangle mirrors."""
    first, second = np.indices((horizon * m, horizon * m))
    # Row a of stage k, and control b of stage j ≤ k.
    k, a = np.divmod(np.maximum(first, second), m)
    j, b = np.divmod(np.minimum(first, second), m)
    column: NDArray[np.int64] = k * (horizon * m + n + 1) + (k - j) * m + b
    return column * m + a


def _response_positions(n: int, m: int, horizon: int) -> NDArray[np.int64]:
    """Positions of Γ's entries, (Nn, Nm), in the responses of ξ_1 … ξ_N; −1 above its diagonal."""
    first, second = np.indices((horizon * n, horizon * m))
    # State i of stage k+1, and control b of stage j.
    k, i = np.divmod(first, n)
    j, b = np.divmod(second, m)
    column = k * (horizon * m + n + 1) + (k - j) * m + b
    return np.asarray(np.where(j <= k, column * n + i, -1))


def embedding(
    problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction, read: StackedFunction
) -> StackedFunction:
    """Initial value embedding: the vectors of the QP that depend on the state s.

    Args:
        problem: The problem with its scale.
        blocks: The blocks of θ.
        prepared: `preparation`'s function, whose memory holds theta, Φ, g, f and F.
        read: `readout`'s function, in whose memory are the state s and room for the results.

    Returns:
        Function that writes to the read-out's memory the gradient f (Nm,), and the lower and upper
        limits (Nn,) that the soft rows Γ V must respect. s and theta are in the model's units, the
        QP in `Problem.scale`'s.
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    symbols = symbolic_theta(problem, blocks)
    s = ca.SX.sym("s", n)
    x_s = ca.DM(problem.reference_state)
    state_scale = ca.DM(problem.scale.state)
    condensed = {
        "Phi": ca.SX.sym("Phi", n, horizon * n),
        "g": ca.SX.sym("g", horizon * n),
        "f": ca.SX.sym("f", horizon * m),
        "F": ca.SX.sym("F", n, horizon * m),
    }

    xi = (s - x_s) / state_scale
    # What the states do with no control; the rows have room for the controls' part.
    free = condensed["Phi"].T @ xi + condensed["g"]
    lower = (symbols["x_l"] - x_s) / state_scale
    upper = (symbols["x_u"] - x_s) / state_scale
    results = {
        "f": condensed["f"] + condensed["F"].T @ xi,
        "lower": ca.repmat(lower, horizon, 1) - free,
        "upper": ca.repmat(upper, horizon, 1) - free,
    }

    shared = {name: prepared.part(name) for name in condensed}
    shared["theta"] = prepared.inputs["theta"]
    shared["s"] = read.inputs["s"]
    first = read.places["f"].start
    last = read.places["row_upper"].stop
    arguments = {"s": s, "theta": symbols["theta"], **condensed}
    return StackedFunction(
        "embedding",
        arguments,
        results,
        shared,
        memory=read.memory[first:last],
    )


class _SoftBounds(NamedTuple):
    """Bounds of a stage's states in units of `Problem.scale`, and their undiscounted weights.

    All are (n,).
    """

    lower: ca.SX
    upper: ca.SX
    w: ca.SX
    W: ca.SX


def readout(problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction) -> StackedFunction:
    """States, slack, costates, value and residual that belong to a solution of the condensed QP.

    The QP and its solution are in units of `Problem.scale`, the results in the model's. The
    costates χ solve the adjoint recursion, so χ_0 is the gradient of the value in s. The solution
    shifted by one stage is the next point of linearisation.

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.
        prepared: `preparation`'s function: theta and the QP's A, B, r, L, q, L_N, q_N are read from
            its memory.

    Returns:
        Function of s (n); the primal-dual solution v (m, N), lam (n, N), nu (m, N) with the limits
        `lower` and `upper` (m, N) of v; the constant of the QP's stage costs. Its results are
        xi (n, N+1), t (n, N), chi (n, N+1), value; `residual`, see `_residual`; next_x (n, N),
        next_u (m, N) in absolute units, next_chi (n, N), the costates of stages that weigh 1/γ as
        much. Behind them its memory has room for the rest of a solution: what `embedding` gives,
        and what compiled code gives, `iterations` of the QP's solver and the gradient (n_θ,).
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    scale = problem.scale
    state_scale = ca.DM(scale.state)
    price = ca.DM(scale.state_price)
    x_s = ca.DM(problem.reference_state)
    symbols = symbolic_theta(problem, blocks)
    given = _readout_symbols(n, m, horizon)
    s = given["s"]
    deviation = s - x_s
    bounds = _SoftBounds(
        lower=(symbols["x_l"] - x_s) / state_scale,
        upper=(symbols["x_u"] - x_s) / state_scale,
        w=symbols["w_sigma"] / price,
        W=symbols["W_sigma"] * (state_scale / price),
    )
    A = ca.horzsplit(given["A"], n)
    B = ca.horzsplit(given["B"], n)
    r = ca.horzsplit(given["r"])
    L = ca.horzsplit(given["L"], n + m)
    q = ca.horzsplit(given["q"])
    v = ca.horzsplit(given["v"])
    lam = ca.horzsplit(given["lam"])

    # Forward: states, slack and value. The penalty of s itself is that of the true bounds.
    penalty = problem.symbolic_penalty(s)
    value = given["constant"] + penalty + symbols["c_lambda"]
    value += ca.bilin(symbols["B_lambda"], deviation) + ca.dot(symbols["b_lambda"], deviation)
    value /= scale.cost
    xi = [deviation / state_scale]
    slack = []
    for k in range(horizon):
        w = ca.vertcat(xi[k], v[k])
        value += ca.bilin(L[k], w) / 2 + ca.dot(q[k], w)
        xi.append(A[k].T @ xi[k] + B[k].T @ v[k] + r[k])
        above = xi[k + 1] - symbols["x_u"] / state_scale + x_s / state_scale
        outside = ca.fmax(bounds.lower - xi[k + 1], above)
        t = ca.fmax(outside, 0)
        slack.append(t)
        value += problem.discount ** (k + 1) * (ca.dot(bounds.w, t) + ca.dot(bounds.W, t**2))
    value += ca.bilin(given["L_N"], xi[horizon]) / 2 + ca.dot(given["q_N"], xi[horizon])

    # Backward: costates. That of stage 0 has the initial cost in place of a soft row.
    chi = [given["L_N"] @ xi[horizon] + given["q_N"] + lam[horizon - 1]]
    for k in reversed(range(horizon)):
        w = ca.vertcat(xi[k], v[k])
        costate = L[k][:n, :] @ w + q[k][:n] + A[k] @ chi[0]
        if k == 0:
            costate += (2 * symbols["B_lambda"] @ deviation + symbols["b_lambda"]) / price
            costate += ca.gradient(penalty, s) / price
        else:
            costate += lam[k - 1]
        chi.insert(0, costate)

    actions = given["v"] * ca.repmat(ca.DM(scale.action), 1, horizon)
    states = [column * state_scale for column in xi]
    costates = [column * price for column in chi]
    results = {
        "xi": ca.horzcat(*states),
        "t": ca.horzcat(*(column * state_scale for column in slack)),
        "chi": ca.horzcat(*costates),
        "value": value * scale.cost,
        **_shifted(problem, states, actions, costates),
        "residual": _residual(given, xi, chi, bounds, problem.discounts[1:].tolist()),
    }
    from_preparation = ("A", "B", "r", "L", "q", "L_N", "q_N", "theta")
    room = {
        "f": horizon * m,
        "row_lower": horizon * n,
        "row_upper": horizon * n,
        "iterations": 1,
        "gradient": blocks.size,
    }
    return StackedFunction(
        "readout",
        {**given, "theta": symbols["theta"]},
        results,
        {name: prepared.part(name) for name in from_preparation},
        room=room,
    )


def _shifted(
    problem: Problem, states: Sequence[ca.SX], actions: ca.SX, costates: Sequence[ca.SX]
) -> dict[str, ca.SX]:
    """The next point of linearisation: the first stage dropped, the last control repeated.

    `states` ξ_0 … ξ_N and `actions` v (m, N) are deviations from the reference, in the model's
    units as `costates` χ_0 … χ_N.
    """
    x_s = ca.DM(problem.reference_state)
    u_s = ca.DM(problem.reference_action)
    next_states = [column + x_s for column in states[1:]]
    next_costates = [column / problem.discount for column in costates[2:]]
    next_actions = ca.horzcat(actions[:, 1:], actions[:, -1])
    return {
        "next_x": ca.horzcat(*next_states),
        "next_u": next_actions + ca.repmat(u_s, 1, problem.horizon),
        "next_chi": ca.horzcat(*next_costates, costates[-1]),
    }


def _readout_symbols(n: int, m: int, horizon: int) -> dict[str, ca.SX]:
    """Symbols of the read-out's inputs but θ, in the order in which C gives them."""
    shapes = {
        "s": (n, 1),
        "v": (m, horizon),
        "lam": (n, horizon),
        "nu": (m, horizon),
        "lower": (m, horizon),
        "upper": (m, horizon),
        "A": (n, n * horizon),
        "B": (m, n * horizon),
        "r": (n, horizon),
        "L": (n + m, horizon * (n + m)),
        "q": (n + m, horizon),
        "L_N": (n, n),
        "q_N": (n, 1),
        "constant": (1, 1),
    }
    return {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}


def _residual(
    given: Mapping[str, ca.SX],
    xi: Sequence[ca.SX],
    chi: Sequence[ca.SX],
    bounds: _SoftBounds,
    discounts: Sequence[float],
) -> ca.SX:
    """How far a solution is from optimal, without a unit and without what condensing rounds off.

    The states ξ and the costates χ come from v, λ and the stages' own data, so the dynamics hold.
    What is left of the optimality conditions is, with σ_j the largest of |L w + q|_j, |Bᵀχ|_j,
    |ν_j| and the curvature of one step, the largest of

        |L w + q + Bᵀχ + ν|_j / σ_j,  |v − clip(v + ν/σ)|_j,  |y − prox(y + λ/w)|_i / (1 + |y_i|)

    with y = ξ_{k+1}. The last is that of the soft bound Σ t + (W/w) t²; feasibility, sign and
    complementarity at once. All are zero exactly at the solution.
    """
    m = given["v"].size1()
    n, horizon = given["lam"].shape
    B = ca.horzsplit(given["B"], n)
    L = ca.horzsplit(given["L"], n + m)
    errors = []
    for k in range(horizon):
        v = given["v"][:, k]
        nu = given["nu"][:, k]
        next_weight = given["L_N"] if k + 1 == horizon else L[k + 1][:n, :n]

        cost = L[k][n:, :] @ ca.vertcat(xi[k], v) + given["q"][n:, k]
        pull = B[k] @ chi[k + 1]
        next_curvature = ca.fabs(ca.diag(next_weight))
        # The curvature in v_k: of its own stage, and of the next one through the state.
        curvature = ca.fabs(ca.diag(L[k][n:, n:])) + B[k] ** 2 @ next_curvature
        size = ca.fabs(cost)
        for other in (ca.fabs(pull), ca.fabs(nu), curvature):
            size = ca.fmax(size, other)
        size = ca.fmax(size, LEAST_SIZE)
        errors.append(ca.fabs(cost + pull + nu) / size)

        shifted = v + nu / size
        projection = ca.fmin(ca.fmax(shifted, given["lower"][:, k]), given["upper"][:, k])
        errors.append(ca.fabs(v - projection))

        # As in `SoftQp.residual`, by the undiscounted weights.
        y = xi[k + 1]
        shifted = y + given["lam"][:, k] / (discounts[k] * bounds.w)
        nearest = ca.fmin(ca.fmax(shifted, bounds.lower), bounds.upper)
        beyond = shifted - nearest
        violation = ca.fmax(ca.fabs(beyond) - 1, 0) / (1 + 2 * bounds.W / bounds.w)
        proximal = nearest + ca.sign(beyond) * violation
        errors.append(ca.fabs(y - proximal) / (1 + ca.fabs(y)))

    first, *others = ca.vertsplit(ca.vertcat(*errors))
    largest = first
    for error in others:
        largest = ca.fmax(largest, error)
    return largest


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues (N, s) and eigenvectors (N, s, s) of the blocks before they were lifted.

    The blocks are those of steps `ranges` (s,) of (x, u), with costs relative to a level: their
    eigenvalues have no unit, and the lift is the same in every unit. `floor` (N, 1) is theirs.
    """

    values: Vector
    vectors: Vector
    floor: Vector
    ranges: Vector

    def undecided(self, tolerance: float = 1e-6) -> bool:
        """Whether an eigenvalue is so close to the floor that the lift has a kink there."""
        # At the floor itself the lift has a kink, and its derivative is one-sided.
        distance = np.abs(self.values - self.floor)
        return bool((distance < tolerance * np.maximum(1.0, np.abs(self.values))).any())

    def contract(self, seed: Vector) -> Vector:
        """Adjoint of the derivative of L = P(·): M with ⟨seed, dL⟩ = ⟨M, dX⟩, shapes (N, s, s).

        L, X and the seed are in the model's units. The derivative of a spectral function is a
        Schur product with its divided differences in the eigenbasis (Daleckii and Krein).
        """
        metric = np.outer(self.ranges, self.ranges)
        lifted = np.maximum(self.values, self.floor)
        unlifted = (self.values > self.floor).astype(float)

        # Divided differences (P(a) − P(b)) / (a − b); of equal eigenvalues the derivative of P.
        gap = self.values[:, :, None] - self.values[:, None, :]
        rise = lifted[:, :, None] - lifted[:, None, :]
        slope = unlifted[:, :, None] * unlifted[:, None, :]
        same = np.abs(gap) < 1e-12 * np.maximum(1.0, np.abs(self.values).max())
        divided = np.where(same, slope, rise / np.where(same, 1, gap))

        transposed = self.vectors.transpose(0, 2, 1)
        in_eigenbasis = transposed @ (seed / metric) @ self.vectors
        product = self.vectors @ (divided * in_eigenbasis) @ transposed
        return np.asarray(product * metric)


class GaussNewton:
    """L_k = 2γᵏB_l, the Hessian of the cost: the QP then holds the paper's cost as it is.

    It fills the QP's stage costs ½wᵀL_k w + q_kᵀw in the memory of the preparation, in units of
    `Problem.scale`; `functions` are the CasADi functions that it calls, by the prefix of their
    constants in C, `spectrum` that of the last blocks if they were lifted. `bend` (n+m, n+m) and
    `slope` (n+m,) bring a cost's second and first derivatives from the model's units to the QP's.
    """

    source = "gauss_newton.h"
    """The rule in C."""
    lifts = False
    spectrum: Spectrum | None = None

    def __init__(self, problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction) -> None:
        width = problem.n_states + problem.n_actions
        self.functions: dict[str, StackedFunction] = {}
        self.discounts = problem.discounts[:-1]
        self._end_discount = float(problem.discounts[-1])
        scale = problem.scale
        self.bend = np.outer(scale.both, scale.both) / scale.cost
        self.slope = scale.both / scale.cost
        # Views of the preparation's memory: what is written to them is in the QP.
        self.L = prepared.inputs["L"].reshape(problem.horizon, width, width)
        self.q = prepared.inputs["q"].reshape(problem.horizon, width)
        self._L_N = prepared.inputs["L_N"]
        self._q_N = prepared.inputs["q_N"]

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over a new θ: its costs, which no linearisation point changes here."""
        n = self._q_N.size
        self.L[:] = 2 * self.discounts[:, None, None] * parameters["B_l"] * self.bend
        self.q[:] = self.discounts[:, None] * parameters["b_l"] * self.slope
        terminal = 2 * self._end_discount * parameters["B_Vf"] * self.bend[:n, :n]
        self._L_N[:] = terminal.reshape(-1)
        self._q_N[:] = self._end_discount * parameters["b_Vf"] * self.slope[:n]

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write L and q for a point of linearisation.

        Args:
            x: Its states x_0 … x_{N−1}, (N, n).
            u: Its actions, (N, m).
            costates: Its costates χ̄_1 … χ̄_N, (N, n).

        Returns:
            The constant of the stage costs, in the model's unit of cost.
        """
        return 0.0


class Exact(GaussNewton):
    """L_k = P(2γᵏB_l + D_k), D_k the curvature of χ̄_{k+1}ᵀf at the linearisation point.

    P lifts the eigenvalues of each stage's block to at least γᵏ·`FLOOR`, so that the QP keeps its
    stage structure and is strictly convex. They are those of the block over the ranges of (x, u)
    and relative to the level of the cost in `Problem.scale`, so P is the same in every unit. The
    floor does not depend on θ, so that P can be differentiated. The terminal cost has no curvature
    of the model and stays as it is. Where `lifts` is false P is the identity, and the QP may be
    indefinite.
    """

    source = "exact.h"
    FLOOR = 1e-3

    def __init__(self, problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction) -> None:
        super().__init__(problem, blocks, prepared)
        self.lifts = True
        self._reference = problem.reference
        self._ranges = problem.scale.ranges
        self.metric = np.outer(self._ranges, self._ranges) / problem.scale.level
        self._curvature = _curvature_by_stage(problem, blocks)
        self.functions["CURVATURE"] = self._curvature

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over the costs of θ."""
        super().set_parameters(parameters)
        self._B = parameters["B_l"]
        self._b = parameters["b_l"]
        self._curvature.inputs["theta"][:] = parameters.theta

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write the convexified blocks and the gradients that go with them; see `GaussNewton`."""
        curvature = self._curvature
        curvature.inputs["x"][:] = x.reshape(-1)
        curvature.inputs["u"][:] = u.reshape(-1)
        curvature.inputs["guess"][:] = costates.reshape(-1)
        curvature()
        discounts = self.discounts
        blocks = 2 * discounts[:, None, None] * self._B + curvature.part("D").reshape(self.L.shape)
        if not np.isfinite(blocks).all():
            # The controller refuses the QP; an eigenvalue solver would raise its own error.
            self.L[:] = np.nan
            return np.nan

        self.spectrum = None
        if self.lifts:
            blocks += self._lift(blocks)

        # The cost is expanded about the point of linearisation: its gradient there is that of ℓ_θ,
        # and the QP's variables are deviations from the reference.
        point = np.concatenate([x, u], axis=1) - self._reference
        curved = np.einsum("kij,kj->ki", blocks, point)
        flat = 2 * discounts[:, None] * (point @ self._B)
        self.L[:] = blocks * self.bend
        self.q[:] = (flat + discounts[:, None] * self._b - curved) * self.slope
        return float((point * (curved - flat)).sum() / 2)

    def _lift(self, blocks: Vector) -> Vector:
        """What lifts the eigenvalues of blocks (N, n+m, n+m) to the floor; keeps their spectrum."""
        values, vectors = np.linalg.eigh(blocks * self.metric)
        floor = np.asarray(self.FLOOR * self.discounts[:, None], dtype=np.float64)
        self.spectrum = Spectrum(values, vectors, floor, self._ranges)
        # What is to be lifted is added: what is above the floor keeps its digits.
        rise = np.maximum(floor - values, 0.0)
        lift = (vectors * rise[:, None, :]) @ vectors.transpose(0, 2, 1) / self.metric
        return np.asarray(lift)


def _curvature_by_stage(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """D_k (n+m, n+m) of all stages from x (n, N), u (m, N), guess (n, N), which is χ̄, and theta."""
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    x, u, symbols = _linearisation_symbols(problem, blocks)
    chi = ca.SX.sym("chi", n)
    stage = stage_function(
        "curvature_of_stage",
        {"x": x, "u": u, "chi": chi, "theta": symbols["theta"]},
        {"D": _curvature(problem, symbols, x, u, chi)},
    )
    arguments = {
        "x": ca.MX.sym("x", n, horizon),
        "u": ca.MX.sym("u", m, horizon),
        "guess": ca.MX.sym("guess", n, horizon),
        "theta": ca.MX.sym("theta", blocks.size),
    }
    theta = ca.repmat(arguments["theta"], 1, horizon)
    D = stage.map(horizon)(arguments["x"], arguments["u"], arguments["guess"], theta)
    return StackedFunction("curvature", arguments, {"D": D})


HESSIANS = {"gauss-newton": GaussNewton, "exact": Exact}


class SampleFunctions:
    """The CasADi functions that make a sample's QP and read its solution out.

    `preparation` and `embedding` make the QP with the rule `hessian`, `readout` takes its value.
    The memory of the first and the last hold a sample's QP and its solution. Raises ControllerError
    on an unknown Hessian, ModelError where the model is too stiff for the problem's substeps.
    """

    def __init__(self, problem: Problem, blocks: ThetaBlocks, hessian: str) -> None:
        if hessian not in HESSIANS:
            raise ControllerError(f"there is no Hessian '{hessian}'{instead(hessian, HESSIANS)}")
        self.integration = check_integration(problem)
        self.problem = problem
        self.blocks = blocks
        self.preparation = preparation(problem, blocks)
        self.readout = readout(problem, blocks, self.preparation)
        self.embedding = embedding(problem, blocks, self.preparation, self.readout)
        self.hessian = HESSIANS[hessian](problem, blocks, self.preparation)

    @cached_property
    def stage(self) -> ca.Function:
        """The linearisation of one stage, which C calls for each."""
        return stage_linearisation(self.problem, self.blocks)

    @property
    def named(self) -> dict[str, StackedFunction]:
        """The functions by the prefix of their constants in C."""
        functions = {
            "PREPARED": self.preparation,
            "EMBEDDED": self.embedding,
            "READ": self.readout,
        }
        return functions | self.hessian.functions

    def qp(self, before: Vector, after: Vector) -> SoftQp:
        """The QP in the memory of preparation and read-out, or in copies of it.

        Args:
            before: Memory of `preparation`, or a copy.
            after: Memory of `readout`, or a copy.

        Returns:
            A QP of views: what is written to the memory changes it.
        """
        return SoftQp(
            H=self.preparation.matrix("H", before),
            f=self.readout.part("f", after),
            lower=self.readout.part("lower", after),
            upper=self.readout.part("upper", after),
            rows=self.preparation.matrix("Gamma", before),
            row_lower=self.readout.part("row_lower", after),
            row_upper=self.readout.part("row_upper", after),
            w=self.preparation.part("w", before),
            W=self.preparation.part("W", before),
        )
