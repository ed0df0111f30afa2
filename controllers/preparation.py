"""A sample in CasADi: linearise and condense to a QP, put the state in, read the solution out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ControllerError
from controllers.functions import StackedFunction
from controllers.integration import check_integration
from controllers.model import runge_kutta
from controllers.problem import Problem
from controllers.qp import SoftQp
from controllers.theta import Parameters, Symbols, ThetaBlocks, symbolic_theta
from cosim.core.protocols import Vector
from cosim.core.validation import instead

RESIDUAL = 1e-8
"""Largest KKT residual of a QP that counts as solved."""
TINY = 1e-30
"""What a size is at least, so that it can divide."""


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

    def both(at: ca.SX) -> ca.SX:
        value, by_state, by_action = slope(at[:, 0], u, *free)
        moved = by_state @ at[:, 1:] + ca.horzcat(ca.SX(n, n), by_action)
        return ca.horzcat(value, moved)

    start = ca.horzcat(x, ca.SX.eye(n), ca.SX(n, m))
    end = runge_kutta(both, start, h, problem.substeps)
    return end[:, 0], end[:, 1:]


def stage_linearisation(problem: Problem, blocks: ThetaBlocks) -> ca.Function:
    """One stage's A_k, B_k and r_k of ξ₊ = A_k ξ + B_k v + r_k, as a function of (x, u, theta).

    x (n) and u (m) are in absolute units; the results are A_kᵀ (n, n), B_kᵀ (m, n) and r_k (n),
    which holds the model offset c_f too, for ξ and v in units of `Problem.scale`.
    """
    n, scale = problem.n_states, problem.scale
    x, u, symbols = _point(problem, blocks)
    x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
    x_next, jacobian = sampled_jacobian(problem, x, u, symbols["model_parameters"])
    a, b = jacobian[:, :n], jacobian[:, n:]
    offset = x_next - x_s - a @ (x - x_s) - b @ (u - u_s) + symbols["c_f"]
    by_state = ca.DM(np.outer(1 / scale.state, scale.state))
    by_action = ca.DM(np.outer(1 / scale.state, scale.action))
    scaled = {"A": (a * by_state).T, "B": (b * by_action).T, "r": offset / ca.DM(scale.state)}
    return stage_function("linearise", {"x": x, "u": u, "theta": symbols["theta"]}, scaled)


def stage_parameter_gradient(problem: Problem, blocks: ThetaBlocks, *, exact: bool) -> ca.Function:
    """One stage's ∇_p of the QP's Lagrangian in the model parameters p that θ holds.

    That is ∇_p [χᵀ(f + J Δw) + ⟨M, D⟩] with f and its Jacobian J at (x, u) and the step
    Δw = w − (x, u) to the QP's solution. With `exact`, D is the curvature of χ̄ᵀf under weights M.
    The multipliers are contracted before anything is differentiated, so that one tangent goes
    through the model in place of n + m. Arguments x, u, theta, w (n+m) in absolute units, chi (n)
    and, with `exact`, M (n+m, n+m) and guess (n); result `gradient` (n_p).
    """
    n, m = problem.n_states, problem.n_actions
    x, u, symbols = _point(problem, blocks)
    w, chi = ca.SX.sym("w", n + m), ca.SX.sym("chi", n)
    x_next, _ = sampled_jacobian(problem, x, u, symbols["model_parameters"])
    point = ca.vertcat(x, u)
    part = ca.dot(chi, x_next + ca.jtimes(x_next, point, w - point))
    arguments = {"x": x, "u": u, "theta": symbols["theta"], "w": w, "chi": chi}
    if exact:
        M, guess = ca.SX.sym("M", n + m, n + m), ca.SX.sym("guess", n)
        part += ca.dot(M, _curvature(problem, symbols, x, u, guess))
        arguments |= {"M": M, "guess": guess}
    gradient = ca.gradient(part, symbols["theta"])[blocks.slices["p"]]
    return stage_function("parameter_gradient", arguments, {"gradient": gradient})


def stage_function(
    name: str, arguments: Mapping[str, ca.SX], results: Mapping[str, ca.SX]
) -> ca.Function:
    """Function of one stage, to be mapped over the horizon: dense, common expressions shared."""
    return ca.Function(
        name,
        [ca.densify(argument) for argument in arguments.values()],
        [ca.densify(result) for result in results.values()],
        list(arguments),
        list(results),
        {"cse": True},
    )


def _point(problem: Problem, blocks: ThetaBlocks) -> tuple[ca.SX, ca.SX, Symbols]:
    x, u = ca.SX.sym("x", problem.n_states), ca.SX.sym("u", problem.n_actions)
    return x, u, symbolic_theta(problem, blocks)


def _curvature(problem: Problem, symbols: Symbols, x: ca.SX, u: ca.SX, chi: ca.SX) -> ca.SX:
    x_next, _ = sampled_jacobian(problem, x, u, symbols["model_parameters"])
    hessian, _ = ca.hessian(ca.dot(chi, x_next), ca.vertcat(x, u))
    return hessian


def preparation(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """Linearise and condense: all of the QP that does not depend on the state s.

    All of the QP is in units of `Problem.scale`: states ξ, actions v and costs.
    With V = (v_0, …, v_{N−1}) the predicted states are Ξ = Γ V + Φ ξ_0 + g, and the cost is
    ½VᵀHV + (f + F ξ_0)ᵀV + const. for stage costs ½wᵀL_k w + q_kᵀw and terminal ½ξᵀL_N ξ + q_Nᵀξ.

    Inputs: x (n, N) and u (m, N), the linearisation points; L (n+m, N(n+m)), q (n+m, N),
    L_N (n, n), q_N (n); theta. Results: A, B, r by stage; H, Γ by rows; Φ, g, f, F. Behind them
    its memory has room for the rest of the QP: the costates (N, n) of the linearisation point, the
    discounted slack weights w and W (Nn,), and the constant of the stage costs.

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
    return StackedFunction(
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
        room={"costates": horizon * n, "w": horizon * n, "W": horizon * n, "constant": 1},
    )


def _respond(n: int, m: int, horizon: int) -> ca.Function:
    """Responses (n, Nm + n + 1) of ξ_{k+1} from those of ξ_k: to each control, ξ_0 and offsets."""
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
    """Rows (m, Nm + n + 1) of the gradient in v_k and costates (n, Nm + n + 1) at stage k."""
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
    """Positions of H's entries, (Nm, Nm), in the rows of all stages; its upper triangle mirrors."""
    first, second = np.indices((horizon * m, horizon * m))
    (k, a), (j, b) = (np.divmod(pick(first, second), m) for pick in (np.maximum, np.minimum))
    column: NDArray[np.int64] = k * (horizon * m + n + 1) + (k - j) * m + b
    return column * m + a


def _response_positions(n: int, m: int, horizon: int) -> NDArray[np.int64]:
    """Positions of Γ's entries, (Nn, Nm), in the responses of ξ_1 … ξ_N; −1 above its diagonal."""
    first, second = np.indices((horizon * n, horizon * m))
    (k, i), (j, b) = np.divmod(first, n), np.divmod(second, m)
    column = k * (horizon * m + n + 1) + (k - j) * m + b
    return np.asarray(np.where(j <= k, column * n + i, -1))


def embedding(
    problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction, read: StackedFunction
) -> StackedFunction:
    """Initial value embedding: the vectors of the QP that depend on the state s.

    Inputs: s, read from the read-out's memory; theta and the rest from the preparation's. Results,
    written to the read-out's memory: the gradient f, and the lower and upper limits that the soft
    rows Γ V must respect. s and theta are in the model's units, the QP in `Problem.scale`'s.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    symbols = symbolic_theta(problem, blocks)
    s = ca.SX.sym("s", n)
    x_s, state = ca.DM(problem.reference_state), ca.DM(problem.scale.state)
    xi = (s - x_s) / state
    prior = {
        "Phi": ca.SX.sym("Phi", n, horizon * n),
        "g": ca.SX.sym("g", horizon * n),
        "f": ca.SX.sym("f", horizon * m),
        "F": ca.SX.sym("F", n, horizon * m),
    }
    free = prior["Phi"].T @ xi + prior["g"]
    lower = ca.repmat((symbols["x_l"] - x_s) / state, horizon, 1) - free
    upper = ca.repmat((symbols["x_u"] - x_s) / state, horizon, 1) - free
    return StackedFunction(
        "embedding",
        {"s": s, "theta": symbols["theta"], **prior},
        {"f": prior["f"] + prior["F"].T @ xi, "lower": lower, "upper": upper},
        {name: prepared.part(name) for name in prior}
        | {"theta": prepared.inputs["theta"], "s": read.inputs["s"]},
        memory=read.memory[read.places["f"].start : read.places["row_upper"].stop],
    )


def readout(problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction) -> StackedFunction:
    """States, slack, costates, value and residual that belong to a solution of the condensed QP.

    Inputs: s (n); the primal-dual solution v (m, N), lam (n, N), nu (m, N) with the limits `lower`
    and `upper` (m, N) of v; the constant of the QP's stage costs; theta and the QP's A, B, r, L, q,
    L_N, q_N are read from the preparation's memory. Results: xi (n, N+1), t (n, N), chi (n, N+1),
    value; `residual`, see `_residual`. The costates χ solve the adjoint recursion, so χ_0 is the
    gradient of the value in s. The solution shifted by one stage is the next point of
    linearisation: next_x (n, N), next_u (m, N) in absolute units, next_chi (n, N), the costates of
    stages that weigh 1/γ as much. Behind them its memory has room for the rest of a solution: what
    `embedding` gives, and what compiled code gives, `iterations` of the QP's solver and the
    gradient (n_θ,).

    The QP and its solution are in units of `Problem.scale`, the results in the model's.
    """
    n, m, horizon, gamma = problem.n_states, problem.n_actions, problem.horizon, problem.discount
    scale = problem.scale
    state, action = ca.DM(scale.state), ca.DM(scale.action)
    price = ca.DM(scale.state_price)
    symbols = symbolic_theta(problem, blocks)
    x_s = ca.DM(problem.reference_state)
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
    given = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
    v, lam, A, B = (given[name] for name in ("v", "lam", "A", "B"))
    L, q, L_N, q_N = (given[name] for name in ("L", "q", "L_N", "q_N"))
    lower, upper = ((symbols[name] - x_s) / state for name in ("x_l", "x_u"))
    w_sigma, W_sigma = symbols["w_sigma"] / price, symbols["W_sigma"] * (state / price)

    s = given["s"]
    known = problem.symbolic_penalty(s)
    away = s - x_s
    value = given["constant"] + known + symbols["c_lambda"]
    value += ca.bilin(symbols["B_lambda"], away) + ca.dot(symbols["b_lambda"], away)
    value /= scale.cost
    xi, t, weights = [away / state], [], []
    for k in range(horizon):
        w = ca.vertcat(xi[k], v[:, k])
        weights.append(L[:, k * (n + m) : (k + 1) * (n + m)])
        value += ca.bilin(weights[k], w) / 2 + ca.dot(q[:, k], w)
        columns = slice(k * n, (k + 1) * n)
        xi.append(A[:, columns].T @ xi[k] + B[:, columns].T @ v[:, k] + given["r"][:, k])
        above = xi[k + 1] - symbols["x_u"] / state + x_s / state
        outside = ca.fmax(lower - xi[k + 1], above)
        t.append(ca.fmax(outside, 0))
        value += gamma ** (k + 1) * (ca.dot(w_sigma, t[k]) + ca.dot(W_sigma, t[k] ** 2))
    value += ca.bilin(L_N, xi[horizon]) / 2 + ca.dot(q_N, xi[horizon])

    chi = [L_N @ xi[horizon] + q_N + lam[:, horizon - 1]]
    for k in reversed(range(horizon)):
        w = ca.vertcat(xi[k], v[:, k])
        costate = weights[k][:n, :] @ w + q[:n, k] + A[:, k * n : (k + 1) * n] @ chi[0]
        if k == 0:
            costate += (2 * symbols["B_lambda"] @ away + symbols["b_lambda"]) / price
            costate += ca.gradient(known, s) / price
        else:
            costate += lam[:, k - 1]
        chi.insert(0, costate)
    limits = (lower, upper, w_sigma, W_sigma)
    discounts = problem.discounts[1:]
    u_s = ca.DM(problem.reference_action)
    actions = v * ca.repmat(action, 1, horizon)
    states = [part * state for part in xi]
    costates = [part * price for part in chi]
    return StackedFunction(
        "readout",
        {**given, "theta": symbols["theta"]},
        {
            "xi": ca.horzcat(*states),
            "t": ca.horzcat(*(part * state for part in t)),
            "chi": ca.horzcat(*costates),
            "value": value * scale.cost,
            "next_x": ca.horzcat(*(part + x_s for part in states[1:])),
            "next_u": ca.horzcat(actions[:, 1:], actions[:, -1]) + ca.repmat(u_s, 1, horizon),
            "next_chi": ca.horzcat(*(part / gamma for part in costates[2:]), costates[-1]),
            "residual": _residual(given, xi, chi, limits, discounts.tolist()),
        },
        {name: prepared.part(name) for name in ("A", "B", "r", "L", "q", "L_N", "q_N", "theta")},
        room={"f": horizon * m}
        | dict.fromkeys(("row_lower", "row_upper"), horizon * n)
        | {"iterations": 1, "gradient": blocks.size},
    )


def _residual(
    given: Mapping[str, ca.SX],
    xi: Sequence[ca.SX],
    chi: Sequence[ca.SX],
    limits: Sequence[ca.SX],
    discounts: Sequence[float],
) -> ca.SX:
    """How far a solution is from optimal, without a unit and without what condensing rounds off.

    The states ξ and the costates χ come from v, λ and the stages' own data, so the dynamics hold.
    What is left of the optimality conditions is, with σ_j the largest of |L w + q|_j, |Bᵀχ|_j,
    |ν_j| and the curvature of one step, the largest of

        |L w + q + Bᵀχ + ν|_j / σ_j,  |v − clip(v + ν/σ)|_j,  |y − prox(y + λ/w)|_i / (1 + |y_i|)

    with y = ξ_{k+1}. The last is that of the soft bound Σ t + (W/w) t², with its `limits`: lower,
    upper, w and W (n,), undiscounted; feasibility, sign and complementarity at once. All are zero
    exactly at the solution.
    """
    v, nu, lam, L, B = (given[name] for name in ("v", "nu", "lam", "L", "B"))
    (m, horizon), n = v.shape, lam.size1()
    lower, upper, w_sigma, W_sigma = limits
    parts = []
    for k in range(horizon):
        by_action = B[:, k * n : (k + 1) * n]
        stage = L[:, k * (n + m) : (k + 1) * (n + m)]
        last = k + 1 == horizon
        following = given["L_N"] if last else L[:n, (k + 1) * (n + m) : (k + 1) * (n + m) + n]
        bent = ca.fabs(ca.diag(following))
        cost = stage[n:, :] @ ca.vertcat(xi[k], v[:, k]) + given["q"][n:, k]
        pull = by_action @ chi[k + 1]
        curvature = ca.fabs(ca.diag(stage[n:, n:])) + by_action**2 @ bent
        sizes = (ca.fabs(pull), ca.fabs(nu[:, k]), curvature)
        size = ca.fabs(cost)
        for other in sizes:
            size = ca.fmax(size, other)
        size = ca.fmax(size, TINY)
        parts.append(ca.fabs(cost + pull + nu[:, k]) / size)
        moved = v[:, k] + nu[:, k] / size
        clipped = ca.fmin(ca.fmax(moved, given["lower"][:, k]), given["upper"][:, k])
        parts.append(ca.fabs(v[:, k] - clipped))
        y, share = xi[k + 1], lam[:, k] / (discounts[k] * w_sigma)
        nearest = ca.fmin(ca.fmax(y + share, lower), upper)
        beyond = y + share - nearest
        shrunk = ca.fmax(ca.fabs(beyond) - 1, 0) / (1 + 2 * W_sigma / w_sigma)
        soft = nearest + ca.sign(beyond) * shrunk
        parts.append(ca.fabs(y - soft) / (1 + ca.fabs(y)))
    every = ca.vertsplit(ca.vertcat(*parts))
    largest = every[0]
    for part in every[1:]:
        largest = ca.fmax(largest, part)
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
        distance = np.abs(self.values - self.floor)
        return bool((distance < tolerance * np.maximum(1.0, np.abs(self.values))).any())

    def contract(self, seed: Vector) -> Vector:
        """Adjoint of the derivative of L = P(·): M with ⟨seed, dL⟩ = ⟨M, dX⟩, shapes (N, s, s).

        L, X and the seed are in the model's units. The derivative of a spectral function is a
        Schur product with its divided differences in the eigenbasis (Daleckii and Krein).
        """
        metric = np.outer(self.ranges, self.ranges)
        seed = seed / metric
        lifted = np.maximum(self.values, self.floor)
        gap = self.values[:, :, None] - self.values[:, None, :]
        rise = lifted[:, :, None] - lifted[:, None, :]
        kept = (self.values > self.floor).astype(float)
        same = np.abs(gap) < 1e-12 * np.maximum(1.0, np.abs(self.values).max())
        divided = np.where(same, kept[:, :, None] * kept[:, None, :], rise / np.where(same, 1, gap))
        transposed = self.vectors.transpose(0, 2, 1)
        moved = self.vectors @ (divided * (transposed @ seed @ self.vectors)) @ transposed
        return np.asarray(moved * metric)


class GaussNewton:
    """L_k = 2γᵏB_l, the Hessian of the cost: the QP then holds the paper's cost as it is.

    It fills the QP's stage costs ½wᵀL_k w + q_kᵀw in the memory of the preparation, in units of
    `Problem.scale`; `functions` are
    the CasADi functions that it calls, by the prefix of their constants in C, `spectrum` that of
    the last blocks if they were lifted.
    """

    source = "gauss_newton.h"
    """The rule in C."""
    lifts = False
    spectrum: Spectrum | None = None

    def __init__(self, problem: Problem, blocks: ThetaBlocks, prepared: StackedFunction) -> None:
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        self.functions: dict[str, StackedFunction] = {}
        self.discounts = problem.discounts[:-1]
        self._end = float(problem.discounts[-1])
        scale = problem.scale
        # What scales a cost's second and first derivatives in the model's units.
        self.bend = np.outer(scale.both, scale.both) / scale.cost
        self.slope = scale.both / scale.cost
        self.L = prepared.inputs["L"].reshape(horizon, n + m, n + m)
        self.q = prepared.inputs["q"].reshape(horizon, n + m)
        self._L_N, self._q_N = prepared.inputs["L_N"], prepared.inputs["q_N"]

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over a new θ: its costs, which no linearisation point changes here."""
        n = self._q_N.size
        self.L[:] = 2 * self.discounts[:, None, None] * parameters["B_l"] * self.bend
        self.q[:] = self.discounts[:, None] * parameters["b_l"] * self.slope
        self._L_N[:] = (2 * self._end * parameters["B_Vf"] * self.bend[:n, :n]).reshape(-1)
        self._q_N[:] = self._end * parameters["b_Vf"] * self.slope[:n]

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write L and q for the points (N, n), (N, m); return the cost's constant."""
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
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        self._reference = problem.reference
        self._ranges = problem.scale.ranges
        self.metric = np.outer(self._ranges, self._ranges) / problem.scale.level
        x, u, symbols = _point(problem, blocks)
        chi = ca.SX.sym("chi", n)
        stage = stage_function(
            "curvature_of_stage",
            {"x": x, "u": u, "chi": chi, "theta": symbols["theta"]},
            {"D": _curvature(problem, symbols, x, u, chi)},
        )
        given = {
            "x": ca.MX.sym("x", n, horizon),
            "u": ca.MX.sym("u", m, horizon),
            "guess": ca.MX.sym("guess", n, horizon),
            "theta": ca.MX.sym("theta", blocks.size),
        }
        *point, theta = given.values()
        D = stage.map(horizon)(*point, ca.repmat(theta, 1, horizon))
        self._curvature = StackedFunction("curvature", given, {"D": D})
        self.functions["CURVATURE"] = self._curvature

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over the costs of θ."""
        super().set_parameters(parameters)
        self._B, self._b = parameters["B_l"], parameters["b_l"]
        self._curvature.inputs["theta"][:] = parameters.theta

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write the convexified blocks and the gradients that go with them."""
        call = self._curvature
        for name, value in (("x", x), ("u", u), ("guess", costates)):
            call.inputs[name][:] = value.reshape(-1)
        call()
        L, q, discounts = self.L, self.q, self.discounts
        raw = 2 * discounts[:, None, None] * self._B + call.part("D").reshape(L.shape)
        if not np.isfinite(raw).all():
            # The controller refuses the QP; an eigenvalue solver would raise its own error.
            L[:] = np.nan
            return np.nan
        if self.lifts:
            values, vectors = np.linalg.eigh(raw * self.metric)
            floor = np.asarray(self.FLOOR * discounts[:, None], dtype=np.float64)
            self.spectrum = Spectrum(values, vectors, floor, self._ranges)
            # What is to be lifted is added: what is above the floor keeps its digits.
            rise = np.maximum(floor - values, 0.0)
            raw += (vectors * rise[:, None, :]) @ vectors.transpose(0, 2, 1) / self.metric
        else:
            self.spectrum = None
        at = np.concatenate([x, u], axis=1) - self._reference
        curved = np.einsum("kij,kj->ki", raw, at)
        flat = 2 * discounts[:, None] * (at @ self._B)
        L[:] = raw * self.bend
        q[:] = (flat + discounts[:, None] * self._b - curved) * self.slope
        return float((at * (curved - flat)).sum() / 2)


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
        self.problem, self.blocks = problem, blocks
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
        own = {"PREPARED": self.preparation, "EMBEDDED": self.embedding, "READ": self.readout}
        return own | self.hessian.functions

    def qp(self, before: Vector, after: Vector) -> SoftQp:
        """The QP in the memory of preparation and read-out, `before` and `after`, or copies."""
        vectors = ("f", "lower", "upper", "row_lower", "row_upper")
        return SoftQp(
            H=self.preparation.matrix("H", before),
            rows=self.preparation.matrix("Gamma", before),
            **{name: self.preparation.part(name, before) for name in ("w", "W")},
            **{name: self.readout.part(name, after) for name in vectors},
        )
