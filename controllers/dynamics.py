"""The model sampled and linearised along a trajectory, in CasADi: A_k, B_k, r_k and curvature."""

from __future__ import annotations

import casadi as ca

from controllers.problem import Problem
from controllers.theta import SymbolicTheta


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
    problem: Problem, symbols: SymbolicTheta, x: ca.SX, u: ca.SX
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
        offset.append(x_next - x_s - a @ (x[:, k] - x_s) - b @ (u[:, k] - u_s) + symbols["c_f"])
    return by_state, by_action, offset


def sampled_curvature(
    problem: Problem, symbols: SymbolicTheta, x: ca.SX, u: ca.SX, chi: ca.SX
) -> list[ca.SX]:
    """Second derivatives D_k of χ_{k+1}ᵀ f(x_k, u_k) with respect to (x, u), stage by stage."""
    curvature = []
    for k in range(problem.horizon):
        point = ca.SX.sym("point", problem.n_states + problem.n_actions)
        x_k, u_k = point[: problem.n_states], point[problem.n_states :]
        x_next, _ = sampled_jacobian(problem, x_k, u_k, symbols.model_parameters)
        costate = ca.SX.sym("costate", problem.n_states)
        hessian, _ = ca.hessian(ca.dot(costate, x_next), point)
        curvature.append(
            ca.substitute(
                hessian,
                ca.vertcat(point, costate),
                ca.vertcat(x[:, k], u[:, k], chi[:, k]),
            )
        )
    return curvature
