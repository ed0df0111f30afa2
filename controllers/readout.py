"""A solution read out: states, slack, costates, value and KKT residual, by a sweep each way.

What one stage does is a function that is called for each, so that the C of a longer horizon is no
larger but for the calls.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from controllers.functions import (
    Definition,
    Shapes,
    StackedFunction,
    call,
    define,
    matrix_symbols,
    scalar_symbols,
    stage_function,
    sweep_function,
)
from controllers.problem import Problem, built_once
from controllers.qp import LEAST_SIZE
from controllers.theta import (
    ThetaBlocks,
    given_parts,
    given_size,
    state_bounds,
    symbolic_given,
    true_bounds,
)
from cosim.core.protocols import Vector


@built_once
def readout_definition(problem: Problem, blocks: ThetaBlocks) -> Definition:
    """States, slack, costates, value and residual that belong to a solution of the condensed QP.

    The QP and its solution are in units of `Problem.scale`, the results in the model's. The
    costates χ solve the adjoint recursion, so χ_0 is the gradient of the value in s. The solution
    shifted by one stage is the next point of linearisation.

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.

    Returns:
        Function of s (n); the primal-dual solution v (m, N), lam (n, N), nu (m, N) with the limits
        `lower` and `upper` (m, N) of v; the QP's A, B, r, L, q, L_N, q_N, the constant of its stage
        costs, and theta. Its results are xi (n, N+1), t (n, N), chi (n, N+1), value; `residual`,
        see `_backward`; next_x (n, N), next_u (m, N) in absolute units, next_chi (n, N), the
        costates of stages that weigh 1/γ as much.
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    arguments = matrix_symbols(
        {
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
            "theta": (given_size(problem, blocks), 1),
        }
    )
    stages = _arguments_by_stage(arguments, _stage_shapes(n, m))
    bounds = soft_bounds(problem, blocks, arguments["theta"])
    # The slack of stage k's end counts from k + 1.
    next_discounts = problem.discounts[1:].tolist()

    # Forward: states, slack and value.
    begin = _begin(problem, blocks)
    first = call(
        begin,
        s=arguments["s"],
        constant=arguments["constant"],
        theta=arguments["theta"],
    )
    value = first["value"]
    xi: list[ca.MX] = [first["xi"]]
    slack: list[ca.MX] = []
    forward = _forward(problem)
    for k in range(horizon):
        moved = call(
            forward,
            **stages[k],
            **bounds[k],
            next_discount=next_discounts[k],
            xi=xi[k],
            value=value,
        )
        value = moved["next_value"]
        xi.append(moved["next_xi"])
        slack.append(moved["t"])

    # Backward: costates and residual, from the gradient of the terminal cost to those of the
    # initial one.
    end = _end_of_horizon(n)
    last = call(
        end,
        xi=xi[horizon],
        value=value,
        L_N=arguments["L_N"],
        q_N=arguments["q_N"],
    )
    by_next_state = last["by_state"]
    next_curvature = last["curvature"]
    residual = ca.MX(0.0)
    chi: list[ca.MX] = []
    backward = _backward(problem)
    for k in reversed(range(horizon)):
        came = call(
            backward,
            **stages[k],
            **bounds[k],
            next_discount=next_discounts[k],
            xi=xi[k],
            next_xi=xi[k + 1],
            by_next_state=by_next_state,
            next_curvature=next_curvature,
            residual=residual,
        )
        by_next_state = came["by_state"]
        next_curvature = came["curvature"]
        residual = came["largest"]
        chi.insert(0, came["next_chi"])
    initial_chi = by_next_state + first["gradient"] + first["penalty_gradient"]
    chi.insert(0, initial_chi)

    # In the model's units.
    scale = problem.scale
    states = _by_rows(ca.horzcat(*xi), scale.state)
    costates = _by_rows(ca.horzcat(*chi), scale.state_price)
    actions = _by_rows(arguments["v"], scale.action)
    results = {
        "xi": states,
        "t": _by_rows(ca.horzcat(*slack), scale.state),
        "chi": costates,
        "value": last["end_value"] * scale.cost,
        **_shifted(problem, states, actions, costates),
        "residual": residual,
    }
    return define("readout", arguments, results)


def readout(
    problem: Problem,
    blocks: ThetaBlocks,
    prepared: StackedFunction,
) -> StackedFunction:
    """`readout_definition` with a memory for a sample's solution.

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.
        prepared: `preparation`'s function: theta and the QP's matrices are read from its memory.

    Returns:
        The function. Behind its results its memory has room for the rest of a solution: what
        `embedding` gives, and what compiled code gives, `iterations` of the QP's solver and the
        gradient (n_θ,).
    """
    n_variables = problem.horizon * problem.n_actions
    n_rows = problem.horizon * problem.n_states
    from_preparation = ("A", "B", "r", "L", "q", "L_N", "q_N", "theta")
    shared = {name: prepared.part(name) for name in from_preparation}
    room = {
        "f": n_variables,
        "row_lower": n_rows,
        "row_upper": n_rows,
        "iterations": 1,
        "gradient": blocks.size,
    }
    definition = readout_definition(problem, blocks)
    return StackedFunction(definition, shared, room=room)


def soft_bounds(problem: Problem, blocks: ThetaBlocks, theta: ca.MX) -> list[dict[str, ca.MX]]:
    """Bounds and weights of the states 1 … N in units of `Problem.scale`, (n,) each.

    Args:
        problem: The problem with its scale.
        blocks: The blocks of θ.
        theta: (θ, σ).

    Returns:
        By state `soft_lower` and `soft_upper`; `state_upper`, the upper bound of the state itself
        and not of its deviation; the undiscounted weights `w` and `W`.
    """
    parts = given_parts(problem, blocks, theta)
    x_l, x_u = state_bounds(problem, parts)
    scaled = _scaled_bounds(problem)
    bounds = []
    for lower, upper in zip(x_l[1:], x_u[1:], strict=True):
        of_state = call(
            scaled,
            x_l=lower,
            x_u=upper,
            w_sigma=parts["w_sigma"],
            W_sigma=parts["W_sigma"],
        )
        bounds.append(of_state)
    return bounds


def _scaled_bounds(problem: Problem) -> ca.Function:
    """Entries of `soft_bounds` for one state, from θ's bounds and weights in the model's units."""
    n = problem.n_states
    scale = problem.scale
    x_s = ca.DM(problem.reference_state)
    state_scale = ca.DM(scale.state)
    price = ca.DM(scale.state_price)
    names = ("x_l", "x_u", "w_sigma", "W_sigma")
    given = scalar_symbols(dict.fromkeys(names, (n, 1)))
    results = {
        "soft_lower": (given["x_l"] - x_s) / state_scale,
        "soft_upper": (given["x_u"] - x_s) / state_scale,
        "state_upper": given["x_u"] / state_scale,
        "w": given["w_sigma"] / price,
        "W": given["W_sigma"] * (state_scale / price),
    }
    return stage_function("soft_bounds", given, results)


def _stage_shapes(n: int, m: int) -> Shapes:
    """A stage's part of the read-out's inputs, in units of `Problem.scale`.

    Aᵀ, Bᵀ and r of the dynamics; L and q of the cost; v, its multiplier ν and limits; λ of the next
    stage's state.
    """
    return {
        "A": (n, n),
        "B": (m, n),
        "r": (n, 1),
        "L": (n + m, n + m),
        "q": (n + m, 1),
        "v": (m, 1),
        "nu": (m, 1),
        "lam": (n, 1),
        "lower": (m, 1),
        "upper": (m, 1),
    }


def _bound_shapes(n: int) -> Shapes:
    """The results of `soft_bounds` for one state, and the discount of its slack."""
    names = ("soft_lower", "soft_upper", "state_upper", "w", "W")
    return {**dict.fromkeys(names, (n, 1)), "next_discount": (1, 1)}


def _arguments_by_stage(arguments: Mapping[str, ca.MX], shapes: Shapes) -> list[dict[str, ca.MX]]:
    """The stages' parts of matrices that have them side by side, by stage."""
    parts = {}
    for name, (_, columns) in shapes.items():
        parts[name] = ca.horzsplit(arguments[name], columns)
    stages = []
    for k in range(len(parts["v"])):
        stages.append({name: by_stage[k] for name, by_stage in parts.items()})
    return stages


def _by_rows(matrix: ca.MX, factors: Vector) -> ca.MX:
    """A matrix whose rows are multiplied by these factors."""
    return matrix * ca.repmat(ca.DM(factors), 1, matrix.size2())


def _begin(problem: Problem, blocks: ThetaBlocks) -> ca.Function:
    """ξ_0, and value and gradients of the initial cost, from s, the constant and (θ, σ).

    The penalty of s itself is that of the true bounds.
    """
    scale = problem.scale
    price = ca.DM(scale.state_price)
    symbols = symbolic_given(problem, blocks)
    B_lambda = symbols["B_lambda"]
    b_lambda = symbols["b_lambda"]
    s = ca.SX.sym("s", problem.n_states)
    constant = ca.SX.sym("constant")

    deviation = s - ca.DM(problem.reference_state)
    penalty = problem.symbolic_penalty(s, true_bounds(problem, symbols))
    linear = ca.dot(b_lambda, deviation)
    value = constant + penalty + symbols["c_lambda"]
    value += ca.bilin(B_lambda, deviation) + linear
    gradient = 2 * B_lambda @ deviation + b_lambda
    penalty_gradient = ca.gradient(penalty, s)
    arguments = {
        "s": s,
        "constant": constant,
        "theta": symbols["theta"],
    }
    results = {
        "xi": deviation / ca.DM(scale.state),
        "value": value / scale.cost,
        "gradient": gradient / price,
        "penalty_gradient": penalty_gradient / price,
    }
    return stage_function("readout_begin", arguments, results)


def _forward(problem: Problem) -> ca.Function:
    """ξ_{k+1} with its slack t, and the value with the stage's cost and the slack's price in it."""
    n = problem.n_states
    m = problem.n_actions
    scale = problem.scale
    stage = scalar_symbols(_stage_shapes(n, m))
    bounds = scalar_symbols(_bound_shapes(n))
    xi = ca.SX.sym("xi", n)
    value = ca.SX.sym("value")

    v = stage["v"]
    next_xi = stage["A"].T @ xi + stage["B"].T @ v + stage["r"]
    origin = ca.DM(problem.reference_state) / ca.DM(scale.state)
    below = bounds["soft_lower"] - next_xi
    above = next_xi - bounds["state_upper"] + origin
    t = ca.fmax(below, above)
    t = ca.fmax(t, 0)
    penalty_of_slack = ca.dot(bounds["w"], t) + ca.dot(bounds["W"], t**2)
    w = ca.vertcat(xi, v)
    next_value = value + _quadratic(stage["L"], stage["q"], w)
    next_value += bounds["next_discount"] * penalty_of_slack
    results = {
        "next_xi": next_xi,
        "t": t,
        "next_value": next_value,
    }
    arguments = {**stage, **bounds, "xi": xi, "value": value}
    return sweep_function("readout_forward", arguments, results)


def _end_of_horizon(n: int) -> ca.Function:
    """The value with the terminal cost in it, that cost's gradient and curvature in ξ_N."""
    symbols = scalar_symbols(
        {
            "xi": (n, 1),
            "value": (1, 1),
            "L_N": (n, n),
            "q_N": (n, 1),
        }
    )
    xi = symbols["xi"]
    L_N = symbols["L_N"]
    q_N = symbols["q_N"]
    results = {
        "end_value": symbols["value"] + _quadratic(L_N, q_N, xi),
        "by_state": L_N @ xi + q_N,
        "curvature": ca.fabs(ca.diag(L_N)),
    }
    return stage_function("readout_end", symbols, results)


def _backward(problem: Problem) -> ca.Function:
    """χ_{k+1}, what comes of it at stage k, and how far the stage is from optimal.

    `by_next_state` is all of the gradient in ξ_{k+1} but its soft row's λ. The residual has no
    unit, and nothing that condensing rounds off: the states ξ and the costates χ come from v, λ and
    the stages' own data, so the dynamics hold. What is left of the optimality conditions is, with
    σ_j the largest of |L w + q|_j, |Bᵀχ|_j, |ν_j| and the curvature of one step, the largest of

        |L w + q + Bᵀχ + ν|_j / σ_j,  |v − clip(v + ν/σ)|_j,  |y − prox(y + λ/w)|_i / (1 + |y_i|)

    with y = ξ_{k+1}. The last is that of the soft bound Σ t + (W/w) t²; feasibility, sign and
    complementarity at once. All are zero exactly at the solution.
    """
    n = problem.n_states
    m = problem.n_actions
    stage = scalar_symbols(_stage_shapes(n, m))
    bounds = scalar_symbols(_bound_shapes(n))
    carried = scalar_symbols(
        {
            "xi": (n, 1),
            "next_xi": (n, 1),
            "by_next_state": (n, 1),
            "next_curvature": (n, 1),
            "residual": (1, 1),
        }
    )

    # Costates, by the adjoint recursion.
    v = stage["v"]
    nu = stage["nu"]
    w = ca.vertcat(carried["xi"], v)
    next_chi = carried["by_next_state"] + stage["lam"]
    cost_gradient = stage["L"] @ w + stage["q"]
    by_state = cost_gradient[:n] + stage["A"] @ next_chi

    # The curvature in v_k: of its own stage, and of the next one through the state.
    curvatures = ca.fabs(ca.diag(stage["L"]))
    curvature = curvatures[n:] + stage["B"] ** 2 @ carried["next_curvature"]
    cost = cost_gradient[n:]
    pull = stage["B"] @ next_chi
    size = ca.fmax(ca.fabs(cost), ca.fabs(pull))
    size = ca.fmax(size, ca.fabs(nu))
    size = ca.fmax(size, curvature)
    size = ca.fmax(size, LEAST_SIZE)
    stationarity = ca.fabs(cost + pull + nu)
    pushed = v + nu / size
    projection = _projection(pushed, stage["lower"], stage["upper"])
    weight = bounds["next_discount"] * bounds["w"]
    errors = [
        stationarity / size,
        ca.fabs(v - projection),
        _soft_bound_error(carried["next_xi"], stage["lam"] / weight, bounds),
    ]
    results = {
        "next_chi": next_chi,
        "by_state": by_state,
        "curvature": curvatures[:n],
        "largest": _largest_entry([carried["residual"], *errors]),
    }
    return sweep_function("readout_backward", {**stage, **bounds, **carried}, results)


def _quadratic(hessian: ca.SX, gradient: ca.SX, w: ca.SX) -> ca.SX:
    """½wᵀHw + gᵀw."""
    return ca.bilin(hessian, w) / 2 + ca.dot(gradient, w)


def _largest_entry(vectors: list[ca.SX]) -> ca.SX:
    """The largest of all entries of these vectors."""
    entries = ca.vertsplit(ca.vertcat(*vectors))
    largest = entries[0]
    for entry in entries[1:]:
        largest = ca.fmax(largest, entry)
    return largest


def _projection(values: ca.SX, lower: ca.SX, upper: ca.SX) -> ca.SX:
    """Projection of values on the box between the limits."""
    from_below = ca.fmax(values, lower)
    return ca.fmin(from_below, upper)


def _soft_bound_error(
    y: ca.SX,
    relative_lam: ca.SX,
    bounds: Mapping[str, ca.SX],
) -> ca.SX:
    """|y − prox(y + λ/w)| / (1 + |y|) of the soft bound, as in `QpSolution.residual`."""
    shifted = y + relative_lam
    nearest = _projection(shifted, bounds["soft_lower"], bounds["soft_upper"])
    beyond = shifted - nearest
    # The slack's weight holds y on the bound until λ is larger than it: a distance of 1 here.
    excess = ca.fabs(beyond) - 1
    charged = ca.fmax(excess, 0)
    curvature = 2 * bounds["W"] / bounds["w"]
    violation = charged / (1 + curvature)
    proximal = nearest + ca.sign(beyond) * violation
    error = ca.fabs(y - proximal)
    size = 1 + ca.fabs(y)
    return error / size


def _shifted(
    problem: Problem,
    states: ca.MX,
    actions: ca.MX,
    costates: ca.MX,
) -> dict[str, ca.MX]:
    """The next point of linearisation: the first stage dropped, the last control repeated.

    States ξ_0 … ξ_N (n, N+1) and actions (m, N) are deviations from the reference, in the model's
    units as the costates χ_0 … χ_N (n, N+1).
    """
    horizon = problem.horizon
    x_s = ca.repmat(ca.DM(problem.reference_state), 1, horizon)
    u_s = ca.repmat(ca.DM(problem.reference_action), 1, horizon)
    next_actions = ca.horzcat(actions[:, 1:], actions[:, -1])
    # A stage that comes to weigh γᵏ⁻¹ in place of γᵏ has costates 1/γ as large.
    next_costates = costates[:, 2:] / problem.discount
    return {
        "next_x": states[:, 1:] + x_s,
        "next_u": next_actions + u_s,
        "next_chi": ca.horzcat(next_costates, costates[:, -1]),
    }
