"""Sensitivities of the QP: dV/dθ, dQ/dθ and, along the KKT adjoints, dπ/dθ.

The QP's value has the gradient ∇θ of the QP's Lagrangian at the primal-dual solution y, and the
derivative of y is minus the inverse KKT matrix times ∇θ∇_y of that Lagrangian (paper.tex, RTI
Sensitivities). Both need one expression only: the part of the Lagrangian that contains θ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache

import casadi as ca
import numpy as np

from controllers.functions import StackedFunction
from controllers.preparation import stage_function, stage_parameter_gradient
from controllers.problem import Problem, Scale
from controllers.qp import QpSolution, SoftQp, kkt_solve
from controllers.theta import Symbols, ThetaBlocks, symbolic_theta
from cosim.core.protocols import Matrix

SOLUTION = ("xi", "t", "chi", "v", "lam")
"""First inputs of the sensitivities: a solution's parts."""


def _theta_part(
    problem: Problem, symbols: Symbols, y: Mapping[str, ca.SX], at: ca.SX, M: ca.SX | None
) -> ca.SX:
    """Terms of the Lagrangian with θ but for p; `at` (n+m, N), M_k = ∂(second-order term)/∂L_k.

    The solution y has `xi`, `chi` (n, N+1), `v` (m, N), slack `t` and `lam` (n, N).
    """
    horizon, gamma, size = problem.horizon, problem.discount, at.size1()
    reference = problem.reference
    part = ca.bilin(symbols["B_lambda"], y["xi"][:, 0]) + ca.dot(symbols["b_lambda"], y["xi"][:, 0])
    part += symbols["c_lambda"]
    for k in range(horizon):
        w = ca.vertcat(y["xi"][:, k], y["v"][:, k])
        stage = ca.dot(symbols["b_l"], w)
        if M is None:
            stage += ca.bilin(symbols["B_l"], w)
        else:
            point, M_k = at[:, k] - reference, M[:, k * size : (k + 1) * size]
            stage += ca.bilin(symbols["B_l"], point, 2 * w - point)
            stage += 2 * ca.dot(M_k, symbols["B_l"])
        part += gamma**k * stage + ca.dot(y["chi"][:, k + 1], symbols["c_f"])
        part += gamma ** (k + 1) * ca.dot(symbols["w_sigma"], y["t"][:, k])
        part += gamma ** (k + 1) * ca.dot(symbols["W_sigma"], y["t"][:, k] ** 2)
        part += ca.dot(ca.fmax(-y["lam"][:, k], 0), symbols["x_l"])
        part -= ca.dot(ca.fmax(y["lam"][:, k], 0), symbols["x_u"])
    end = y["xi"][:, horizon]
    return part + gamma**horizon * (ca.bilin(symbols["B_Vf"], end) + ca.dot(symbols["b_Vf"], end))


def _stage_arguments(
    problem: Problem, inputs: Mapping[str, ca.MX], *, exact: bool
) -> dict[str, ca.MX]:
    """Arguments of `stage_parameter_gradient`, those of stage 0, 1, … side by side."""
    horizon, scale = problem.horizon, problem.scale
    v = inputs["v"] * ca.repmat(ca.DM(scale.action), 1, horizon)
    w = ca.vertcat(inputs["xi"][:, :horizon], v) + ca.repmat(ca.DM(problem.reference), 1, horizon)
    arguments = {
        "x": inputs["x"],
        "u": inputs["u"],
        "theta": ca.repmat(inputs["theta"], 1, horizon),
        "w": w,
        "chi": inputs["chi"][:, 1:],
    }
    if exact:
        arguments |= {"M": inputs["M"], "guess": inputs["guess"]}
    return arguments


def _value_gradient_by_stages(
    problem: Problem,
    blocks: ThetaBlocks,
    inputs: Mapping[str, ca.SX],
    results: Mapping[str, ca.SX],
    *,
    exact: bool,
) -> StackedFunction:
    """The value's gradient with that in p, the sum of a function of one stage over the horizon.

    Args:
        problem: the control problem.
        blocks: the blocks of θ, p among them.
        inputs: arguments of the gradient by name.
        results: `gradient` (n_θ), in which the part of p is missing.
        exact: whether the QP's Hessian is the exact one.

    Returns:
        The function of the same inputs with the whole gradient.
    """
    rest = stage_function("value_gradient_rest", inputs, results)
    symbols = {name: ca.MX.sym(name, *symbol.shape) for name, symbol in inputs.items()}
    stage = stage_parameter_gradient(problem, blocks, exact=exact)
    stages = stage.map(problem.horizon)(*_stage_arguments(problem, symbols, exact=exact).values())
    gradient = rest(*symbols.values())
    gradient[blocks.slices["p"]] = ca.sum2(stages)
    return StackedFunction("value_gradient", symbols, {"gradient": gradient})


def _policy_jacobian_by_stages(
    problem: Problem,
    blocks: ThetaBlocks,
    inputs: Mapping[str, ca.SX],
    results: Mapping[str, ca.SX],
    directions: Sequence[tuple[ca.SX, ca.SX]],
    *,
    exact: bool,
) -> StackedFunction:
    """The policy's derivatives with that in p, a sum of a function of one stage over the horizon.

    Args:
        problem: the control problem.
        blocks: the blocks of θ, p among them.
        inputs: arguments of the derivatives by name.
        results: `policy` (n_θ, m), in which the part of p is missing, and `state` (n, m).
        directions: of each action the adjoint directions of w (n+m, N) and χ (n, N) in the model's
            units.
        exact: whether the QP's Hessian is the exact one.

    Returns:
        The function of the same inputs with all of `policy`.
    """
    horizon = problem.horizon
    moved = {
        f"{name}_{action}": direction
        for action, pair in enumerate(directions)
        for name, direction in zip(("w", "chi"), pair, strict=True)
    }
    rest = stage_function("policy_jacobian_rest", inputs, {**results, **moved})
    symbols = {name: ca.MX.sym(name, *symbol.shape) for name, symbol in inputs.items()}
    parts = dict(zip(rest.name_out(), rest(*symbols.values()), strict=True))
    arguments = _stage_arguments(problem, symbols, exact=exact)
    stage = _moved_stage_gradient(problem, blocks, exact=exact).map(horizon)
    policy = parts["policy"]
    for action in range(problem.n_actions):
        along = [parts[f"w_{action}"], parts[f"chi_{action}"]]
        if exact:
            size = problem.n_states + problem.n_actions
            along.append(ca.reshape(symbols["dM"][:, action], size, horizon * size))
        policy[blocks.slices["p"], action] = -ca.sum2(stage(*arguments.values(), *along))
    return StackedFunction("policy_jacobian", symbols, {"policy": policy, "state": parts["state"]})


def _moved_stage_gradient(problem: Problem, blocks: ThetaBlocks, *, exact: bool) -> ca.Function:
    """Directional derivative of `stage_parameter_gradient` in w, χ and, with `exact`, M."""
    stage = stage_parameter_gradient(problem, blocks, exact=exact)
    names = ("w", "chi", "M") if exact else ("w", "chi")
    arguments = {name: ca.SX.sym(name, *stage.size_in(i)) for i, name in enumerate(stage.name_in())}
    along = {f"moved_{name}": ca.SX.sym(f"moved_{name}", *arguments[name].shape) for name in names}
    variables = ca.veccat(*(arguments[name] for name in names))
    derivative = ca.jtimes(stage(*arguments.values()), variables, ca.veccat(*along.values()))
    return stage_function(
        "moved_parameter_gradient", {**arguments, **along}, {"moved_gradient": derivative}
    )


def sensitivities(  # noqa: PLR0915
    problem: Problem, blocks: ThetaBlocks, *, exact: bool
) -> tuple[StackedFunction, Callable[[], StackedFunction]]:
    """Gradient of the value in θ, and a maker of its derivatives along the KKT adjoints.

    The first maps a solution (xi, v, t, lam, chi), the linearisation points x, u and theta to
    `gradient` (n_θ). The second takes the longest to make and few ask for it. It maps that, the
    QP's A, B, L, L_N and the columns of m adjoint directions dv (mN, m), dt and dlam (nN, m). Its
    results are `policy` (n_θ, m), dπ/dθ transposed, and `state` (n, m), dπ/ds transposed. With
    `exact` both need M (see `_theta_part`) and χ̄, the costates where the curvature was taken, the
    second also dM, the directional derivative of M. v, lam, the QP's matrices and the directions
    are in units of `Problem.scale`, all else in the model's.
    """
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    scale = problem.scale
    state, action = ca.DM(scale.state), ca.DM(scale.action)
    price = ca.DM(scale.state_price)
    symbols = symbolic_theta(problem, blocks)
    columns = {"xi": horizon + 1, "v": horizon, "t": horizon, "lam": horizon, "chi": horizon + 1}
    y = {name: ca.SX.sym(name, m if name == "v" else n, c) for name, c in columns.items()}
    x, u = ca.SX.sym("x", n, horizon), ca.SX.sym("u", m, horizon)
    M = ca.SX.sym("M", n + m, horizon * (n + m))
    guess = ca.SX.sym("guess", n, horizon)
    extra = {"M": M, "guess": guess} if exact else {}
    scaled = {name: ca.SX.sym(name, *y[name].shape) for name in ("v", "lam")}
    units = ca.repmat(action, 1, horizon), ca.repmat(price, 1, horizon)
    in_model_units = [scaled["v"] * units[0], scaled["lam"] * units[1]]
    part = _theta_part(problem, symbols, y, ca.vertcat(x, u), M if exact else None)
    gradient = ca.gradient(part, symbols["theta"])
    solution = {name: y[name] for name in SOLUTION} | scaled
    inputs = {**solution, "x": x, "u": u, "theta": symbols["theta"], **extra}

    def of_scaled(expression: ca.SX) -> ca.SX:
        """The expression of v and lam in the model's units as one of the scaled ones."""
        return ca.substitute([expression], [y["v"], y["lam"]], in_model_units)[0]

    results = {"gradient": of_scaled(gradient)}
    if "p" in blocks:
        # A stage's gradient is a call: written out for each stage, its C takes minutes to compile.
        value = _value_gradient_by_stages(problem, blocks, inputs, results, exact=exact)
    else:
        value = StackedFunction("value_gradient", inputs, results)

    @cache
    def policy_jacobian() -> StackedFunction:
        A, B = ca.SX.sym("A", n, n * horizon), ca.SX.sym("B", m, n * horizon)
        L, L_N = ca.SX.sym("L", n + m, horizon * (n + m)), ca.SX.sym("L_N", n, n)
        dv, dt, dlam = (
            ca.SX.sym(name, rows * horizon, m) for name, rows in (("dv", m), ("dt", n), ("dlam", n))
        )
        dM = ca.SX.sym("dM", (n + m) * horizon * (n + m), m)
        symbol = ca.veccat(*y.values(), *([M] if exact else []))
        policy, by_state, moved_stages = [], [], []
        for i in range(m):
            v_i = ca.reshape(dv[:, i], m, horizon)
            lam_i = ca.reshape(dlam[:, i], n, horizon)
            # The directions of the states and costates that go with them.
            xi_i = [ca.SX(n, 1)]
            for k in range(horizon):
                stage = slice(k * n, (k + 1) * n)
                xi_i.append(A[:, stage].T @ xi_i[k] + B[:, stage].T @ v_i[:, k])
            chi_i = [L_N @ xi_i[horizon] + lam_i[:, horizon - 1]]
            for k in reversed(range(horizon)):
                weight = L[:, k * (n + m) : (k + 1) * (n + m)]
                costate = weight[:n, :] @ ca.vertcat(xi_i[k], v_i[:, k])
                costate += A[:, k * n : (k + 1) * n] @ chi_i[0]
                chi_i.insert(0, costate + (lam_i[:, k - 1] if k else 0))
            # In the model's units: the right-hand side was one unit of the scaled action's price.
            unit = float(scale.action[i] / scale.cost)
            curved = [dM[:, i]] if exact else []
            direction = ca.veccat(
                *(part * state * unit for part in xi_i),
                v_i * ca.repmat(action * unit, 1, horizon),
                ca.reshape(dt[:, i], n, horizon) * ca.repmat(state * unit, 1, horizon),
                lam_i * ca.repmat(price * unit, 1, horizon),
                *(part * price * unit for part in chi_i),
                *curved,
            )
            policy.append(-of_scaled(ca.jtimes(gradient, symbol, direction)))
            by_state.append(-chi_i[0] * price * unit)
            moved_w = ca.vertcat(ca.horzcat(*xi_i[:-1]), v_i) * ca.repmat(
                ca.DM(scale.both) * unit, 1, horizon
            )
            moved_chi = ca.horzcat(*chi_i[1:]) * ca.repmat(price * unit, 1, horizon)
            moved_stages.append((moved_w, moved_chi))
        moved = {"A": A, "B": B, "L": L, "L_N": L_N, "dv": dv, "dt": dt, "dlam": dlam}
        arguments = {**inputs, **moved, **({"dM": dM} if exact else {})}
        results = {"policy": ca.horzcat(*policy), "state": ca.horzcat(*by_state)}
        if "p" in blocks:
            return _policy_jacobian_by_stages(
                problem, blocks, arguments, results, moved_stages, exact=exact
            )
        return StackedFunction("policy_jacobian", arguments, results)

    return value, policy_jacobian


def adjoint_directions(
    qp: SoftQp, solution: QpSolution, n_actions: int
) -> tuple[Matrix, Matrix, Matrix]:
    """Solutions dv, dt, dλ of the KKT system for unit right-hand sides in u_0, a row an action.

    The KKT matrix of the active set is symmetric, so these rows of its inverse are all that dπ/dθ
    and dπ/ds need.
    """
    active, seeds = solution.active(qp), np.eye(n_actions, qp.f.size)
    dv, dlam = kkt_solve(qp, active, seeds, np.zeros((n_actions, qp.w.size)))
    violated, dt = active[2], np.zeros_like(dlam)
    if violated.any():
        moved = (dv @ qp.rows.T)[:, violated]
        dlam[:, violated] = 2 * qp.W[violated] * moved
        dt[:, violated] = np.sign(solution.lam[violated]) * moved
    return dv, dt, dlam


def curvature_directions(
    rows: Matrix,
    dv: Matrix,
    step: Matrix,
    contract: Callable[[Matrix], Matrix],
    scale: Scale,
) -> Matrix:
    """Directional derivatives of M along the adjoint directions, (m, N(n+m)²).

    `rows` are those of the QP, `step` (N, n+m) is Δw of each stage in the model's units, `contract`
    the Hessian's spectrum's, `scale` that of the QP.
    """
    horizon, width = step.shape
    n = rows.shape[0] // horizon
    result = []
    for unit, row in zip(scale.action / scale.cost, dv, strict=True):
        moved = np.zeros((horizon, width))
        moved[1:, :n] = (rows @ row).reshape(horizon, n)[:-1]
        moved[:, n:] = row.reshape(horizon, width - n)
        moved *= scale.both * unit
        seed = (step[:, :, None] * moved[:, None, :] + moved[:, :, None] * step[:, None, :]) / 2
        result.append(contract(seed).reshape(-1))
    return np.array(result)
