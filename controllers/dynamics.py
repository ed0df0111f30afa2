"""The model sampled, linearised and differentiated at one stage, as CasADi functions to map."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from controllers.model import runge_kutta
from controllers.problem import Problem
from controllers.theta import SymbolicTheta, ThetaBlocks


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
    which holds the model offset c_f too.
    """
    n = problem.n_states
    x, u, symbols = _point(problem, blocks)
    x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
    x_next, jacobian = sampled_jacobian(problem, x, u, symbols.model_parameters)
    a, b = jacobian[:, :n], jacobian[:, n:]
    offset = x_next - x_s - a @ (x - x_s) - b @ (u - u_s) + symbols["c_f"]
    return stage_function(
        "linearise",
        {"x": x, "u": u, "theta": symbols.theta},
        {"A": a.T, "B": b.T, "r": offset},
    )


def stage_curvature(problem: Problem, blocks: ThetaBlocks) -> ca.Function:
    """One stage's D_k, the second derivative of χᵀf(x, u) in w = (x, u), by (x, u, chi, theta)."""
    x, u, symbols = _point(problem, blocks)
    chi = ca.SX.sym("chi", problem.n_states)
    return stage_function(
        "curvature_of_stage",
        {"x": x, "u": u, "chi": chi, "theta": symbols.theta},
        {"D": _curvature(problem, symbols, x, u, chi)},
    )


def stage_parameter_gradient(problem: Problem, blocks: ThetaBlocks, *, exact: bool) -> ca.Function:
    """One stage's ∇_p of the QP's Lagrangian in the model parameters p that θ holds.

    That is ∇_p [χᵀ(f + J Δw) + ⟨M, D⟩] with f and its Jacobian J at (x, u), Δw = w − (x, u) the
    step to the QP's solution, and with `exact` the curvature D of χ̄ᵀf under the weights M. The
    multipliers are contracted before anything is differentiated, so that one tangent goes through
    the model in place of n + m. Arguments x, u, theta, w (n+m) in absolute units, chi (n) and, with
    `exact`, M (n+m, n+m) and guess (n); result `gradient` (n_p).
    """
    n, m = problem.n_states, problem.n_actions
    x, u, symbols = _point(problem, blocks)
    w, chi = ca.SX.sym("w", n + m), ca.SX.sym("chi", n)
    x_next, _ = sampled_jacobian(problem, x, u, symbols.model_parameters)
    point = ca.vertcat(x, u)
    part = ca.dot(chi, x_next + ca.jtimes(x_next, point, w - point))
    arguments = {"x": x, "u": u, "theta": symbols.theta, "w": w, "chi": chi}
    if exact:
        M, guess = ca.SX.sym("M", n + m, n + m), ca.SX.sym("guess", n)
        part += ca.dot(M, _curvature(problem, symbols, x, u, guess))
        arguments |= {"M": M, "guess": guess}
    gradient = ca.gradient(part, symbols.theta)[blocks.slices["p"]]
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


def _point(problem: Problem, blocks: ThetaBlocks) -> tuple[ca.SX, ca.SX, SymbolicTheta]:
    x, u = ca.SX.sym("x", problem.n_states), ca.SX.sym("u", problem.n_actions)
    return x, u, SymbolicTheta.of(problem, blocks)


def _curvature(problem: Problem, symbols: SymbolicTheta, x: ca.SX, u: ca.SX, chi: ca.SX) -> ca.SX:
    x_next, _ = sampled_jacobian(problem, x, u, symbols.model_parameters)
    hessian, _ = ca.hessian(ca.dot(chi, x_next), ca.vertcat(x, u))
    return hessian
