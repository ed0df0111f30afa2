"""Sensitivities of the QP: dV/dθ, dQ/dθ and, along the KKT adjoints, dπ/dθ.

The QP's value has the gradient ∇θ of the QP's Lagrangian at the primal-dual solution y, and the
derivative of y is minus the inverse KKT matrix times ∇θ∇_y of that Lagrangian (paper.tex, RTI
Sensitivities). Both need one expression only: the part of the Lagrangian that contains θ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache, cached_property

import casadi as ca
import numpy as np

from controllers.functions import (
    Definition,
    StackedFunction,
    define,
    matrix_symbols,
    scalar_symbols,
    stage_function,
)
from controllers.preparation import stage_parameter_gradient
from controllers.problem import Problem, Scale
from controllers.qp import QpSolution, SoftQp, kkt_solve
from controllers.reuse import built_once
from controllers.stage_symbols import moved_references, stage_columns, symbolic_given
from controllers.theta import Symbols, ThetaBlocks
from controllers.varying import of_kind
from cosim.core.protocols import Matrix

SOLUTION_PARTS = ("xi", "t", "chi", "v", "lam")
"""First inputs of the sensitivities: a solution's parts."""


def _theta_lagrangian(
    problem: Problem,
    symbols: Symbols,
    y: Mapping[str, ca.SX],
    points: ca.SX,
    M: ca.SX | None,
) -> ca.SX:
    """Terms of the QP's Lagrangian that hold θ, all but those of the model's parameters p.

    Args:
        problem: The problem.
        symbols: Symbols of θ and the signals (`symbolic_given`).
        y: Solution in the model's units: `xi` and `chi` (n, N+1), `v` (m, N), the slack `t` and
            the rows' multipliers `lam` (n, N).
        points: Points of linearisation (x, u) in the model's units, (n+m, N).
        M: Derivatives of the second-order term by the blocks L_k of the exact Hessian, side by
            side, (n+m, N(n+m)); None where the Hessian is the cost's own.
    """
    # What does not hold θ has no part in the derivative, and is left out.
    horizon = problem.horizon
    gamma = problem.discount
    B_l = symbols["B_l"]
    b_l = symbols["b_l"]
    xi = ca.horzsplit(y["xi"])
    chi = ca.horzsplit(y["chi"])
    v = ca.horzsplit(y["v"])
    slack = ca.horzsplit(y["t"])
    multipliers = ca.horzsplit(y["lam"])
    point = ca.horzsplit(points)

    references = moved_references(problem, symbols["sigma"])
    has_moved = bool(of_kind(problem.varying, "reference"))

    # λ_θ(ξ_0), then the stages, then V^f_θ(ξ_N).
    terms = _quadratic_form(symbols["B_lambda"], symbols["b_lambda"], xi[0])
    terms += symbols["c_lambda"]
    for k in range(horizon):
        w = ca.vertcat(xi[k], v[k])
        if has_moved:
            w -= references[k]
        stage = ca.dot(b_l, w)
        if M is None:
            stage += ca.bilin(B_l, w)
        else:
            # The cost expanded about the point, where B_l enters the lifted block by M too.
            about = point[k] - problem.reference
            if has_moved:
                about -= references[k]
            M_k = ca.horzsplit(M, w.numel())[k]
            stage += ca.bilin(B_l, about, 2 * w - about)
            stage += 2 * ca.dot(M_k, B_l)
        dynamics = ca.dot(chi[k + 1], symbols["c_f"])
        terms += gamma**k * stage + dynamics

        # The slack's price, which counts from stage 1 on.
        t = slack[k]
        next_discount = gamma ** (k + 1)
        terms += next_discount * ca.dot(symbols["w_sigma"], t)
        terms += next_discount * ca.dot(symbols["W_sigma"], t**2)

        # λ is negative where a lower limit pushes, positive where an upper one does.
        lam = multipliers[k]
        from_below = ca.fmax(-lam, 0)
        from_above = ca.fmax(lam, 0)
        terms += ca.dot(from_below, symbols["x_l"])
        terms -= ca.dot(from_above, symbols["x_u"])
    end = xi[horizon]
    if has_moved:
        end = end - references[horizon][: problem.n_states]
    terminal = _quadratic_form(symbols["B_Vf"], symbols["b_Vf"], end)
    return terms + gamma**horizon * terminal


def _quadratic_form(B: ca.SX, b: ca.SX, x: ca.SX) -> ca.SX:
    """xᵀBx + bᵀx, as θ has its costs: without a half."""
    return ca.bilin(B, x) + ca.dot(b, x)


class _Sensitivities:
    """Symbols and the Lagrangian's gradient in θ, of which both functions are made.

    The QP's v, lam and matrices are inputs in units of `Problem.scale`, all else is in the model's;
    `y` are the symbols of a solution in the model's units, in which the Lagrangian is written.
    """

    def __init__(
        self,
        problem: Problem,
        blocks: ThetaBlocks,
        *,
        exact: bool,
    ) -> None:
        n = problem.n_states
        m = problem.n_actions
        horizon = problem.horizon
        self.problem = problem
        self.blocks = blocks
        self.exact = exact
        solution_shapes = {
            "xi": (n, horizon + 1),
            "v": (m, horizon),
            "t": (n, horizon),
            "lam": (n, horizon),
            "chi": (n, horizon + 1),
        }
        self.y = scalar_symbols(solution_shapes)
        self.scaled = scalar_symbols({"v": (m, horizon), "lam": (n, horizon)})
        points = scalar_symbols({"x": (n, horizon), "u": (m, horizon)})
        curvature: dict[str, ca.SX] = {}
        if exact:
            curvature_shapes = {
                "M": (n + m, horizon * (n + m)),
                "guess": (n, horizon),
            }
            curvature = scalar_symbols(curvature_shapes)
        self.M = curvature.get("M")

        symbols = symbolic_given(problem, blocks)
        theta = symbols["theta"]
        lagrangian = _theta_lagrangian(
            problem,
            symbols,
            self.y,
            ca.vertcat(*points.values()),
            self.M,
        )
        self.gradient = ca.gradient(lagrangian, theta)[: blocks.size]
        """All of it but the part of p, which is a sum of a function of one stage."""

        self.inputs = {
            "xi": self.y["xi"],
            "t": self.y["t"],
            "chi": self.y["chi"],
            "v": self.scaled["v"],
            "lam": self.scaled["lam"],
            **points,
            "theta": theta,
            **curvature,
        }

    def in_scaled_units(self, expression: ca.SX) -> ca.SX:
        """The expression of v and lam in the model's units as one of the scaled ones."""
        scale = self.problem.scale
        horizon = self.problem.horizon
        action_scale = ca.repmat(ca.DM(scale.action), 1, horizon)
        price = ca.repmat(ca.DM(scale.state_price), 1, horizon)
        v = self.scaled["v"] * action_scale
        lam = self.scaled["lam"] * price
        # The QP's own numbers come as they are, so the conversion is part of the function.
        unscaled = [self.y["v"], self.y["lam"]]
        (substituted,) = ca.substitute([expression], unscaled, [v, lam])
        return substituted

    @cached_property
    def value_gradient(self) -> Definition:
        """dV/dθ or dQ/dθ: the Lagrangian's gradient at a solution."""
        results = {"gradient": self.in_scaled_units(self.gradient)}
        if "p" not in self.blocks:
            return define("value_gradient", self.inputs, results)

        # A stage's gradient is called: written out for each stage its C takes minutes to compile.
        rest = stage_function("value_gradient_rest", self.inputs, results)
        stages = self._stage_gradient.map(self.problem.horizon)
        symbols = _call_symbols(self.inputs)
        arguments = self._stage_arguments(symbols)
        by_stage = stages(*arguments)
        gradient = rest(*symbols.values())
        gradient[self._parameters] = ca.sum2(by_stage)
        return define("value_gradient", symbols, {"gradient": gradient})

    @cached_property
    def policy_jacobian(self) -> Definition:
        """dπ/dθ and dπ/ds, transposed: derivatives of the gradient along the KKT adjoints."""
        problem = self.problem
        n = problem.n_states
        m = problem.n_actions
        horizon = problem.horizon
        width = n + m
        qp_shapes = {
            "A": (n, n * horizon),
            "B": (m, n * horizon),
            "L": (width, horizon * width),
            "L_N": (n, n),
        }
        direction_shapes = {
            "dv": (m * horizon, m),
            "dt": (n * horizon, m),
            "dlam": (n * horizon, m),
        }
        moving = list(self.y.values())
        if self.M is not None:
            direction_shapes["dM"] = (width * horizon * width, m)
            moving.append(self.M)
        qp = scalar_symbols(qp_shapes)
        directions = scalar_symbols(direction_shapes)

        policy = []
        by_state = []
        moved: dict[str, ca.SX] = {}
        for i in range(m):
            column = {name: direction[:, i] for name, direction in directions.items()}
            # In the model's units: the right-hand side was one unit of the scaled action's price.
            unit = float(problem.scale.action[i] / problem.scale.cost)
            direction = self._direction(qp, column, unit)
            derivative = _derivative_along(self.gradient, moving, direction.values())
            # dy/dθ is minus the inverse KKT matrix times ∇θ∇_y: hence the sign.
            policy.append(-self.in_scaled_units(derivative))
            d_xi = direction["xi"]
            d_chi = direction["chi"]
            by_state.append(-d_chi[:, 0])
            # What of the direction the stages' gradients in p need.
            moved[f"w_{i}"] = ca.vertcat(d_xi[:, :-1], direction["v"])
            moved[f"chi_{i}"] = d_chi[:, 1:]
        inputs = {**self.inputs, **qp, **directions}
        results = {
            "policy": ca.horzcat(*policy),
            "state": ca.horzcat(*by_state),
        }
        if "p" not in self.blocks:
            return define("policy_jacobian", inputs, results)
        return self._with_parameters(inputs, results, moved)

    def _with_parameters(
        self,
        inputs: Mapping[str, ca.SX],
        results: Mapping[str, ca.SX],
        moved: Mapping[str, ca.SX],
    ) -> Definition:
        """`policy_jacobian` with the rows of the model's parameters p, from the stages' gradients.

        Args:
            inputs: The function's inputs.
            results: Its results, without p.
            moved: Directional derivatives of w and chi by name, for each action.
        """
        horizon = self.problem.horizon
        rest = stage_function("policy_jacobian_rest", inputs, {**results, **moved})
        stages = self._moved_parameter_gradient().map(horizon)
        symbols = _call_symbols(inputs)
        arguments = self._stage_arguments(symbols)
        values = rest(*symbols.values())
        parts = dict(zip(rest.name_out(), values, strict=True))
        jacobian = parts["policy"]
        for i in range(self.problem.n_actions):
            along = [parts[f"w_{i}"], parts[f"chi_{i}"]]
            if self.exact:
                # A direction of M is a column of dM: by stages side by side again.
                dM = symbols["dM"][:, i]
                as_M = ca.reshape(dM, *symbols["M"].shape)
                along.append(as_M)
            by_stage = stages(*arguments, *along)
            jacobian[self._parameters, i] = -ca.sum2(by_stage)
        results_with_p = {"policy": jacobian, "state": parts["state"]}
        return define("policy_jacobian", symbols, results_with_p)

    @property
    def _parameters(self) -> slice:
        """Place of the model's parameters p in θ."""
        return self.blocks.slices["p"]

    @property
    def _stage_gradient(self) -> ca.Function:
        """A stage's part of the Lagrangian's gradient in p."""
        return stage_parameter_gradient(self.problem, self.blocks, exact=self.exact)

    def _stage_arguments(self, symbols: Mapping[str, ca.MX]) -> list[ca.MX]:
        """Arguments of `stage_parameter_gradient`, those of stage 0, 1, … side by side."""
        problem = self.problem
        horizon = problem.horizon
        theta = stage_columns(problem, self.blocks, symbols["theta"])
        action_scale = ca.repmat(ca.DM(problem.scale.action), 1, horizon)
        reference = ca.repmat(ca.DM(problem.reference), 1, horizon)
        xi = symbols["xi"]
        chi = symbols["chi"]
        v = symbols["v"] * action_scale
        w = ca.vertcat(xi[:, :-1], v)
        w += reference
        arguments = [
            symbols["x"],
            symbols["u"],
            theta,
            w,
            chi[:, 1:],
        ]
        if self.exact:
            arguments += [symbols["M"], symbols["guess"]]
        return arguments

    def _moved_parameter_gradient(self) -> ca.Function:
        """Directional derivative of `stage_parameter_gradient` in w, χ and, if exact, M."""
        stage = self._stage_gradient
        shapes = {name: stage.size_in(name) for name in stage.name_in()}
        arguments = scalar_symbols(shapes)
        moving = ["w", "chi"]
        if self.exact:
            moving.append("M")
        along = scalar_symbols({f"d{name}": shapes[name] for name in moving})

        gradient = stage(*arguments.values())
        variables = [arguments[name] for name in moving]
        derivative = _derivative_along(gradient, variables, along.values())
        return stage_function(
            "moved_parameter_gradient",
            {**arguments, **along},
            {"derivative": derivative},
        )

    def _direction(
        self,
        qp: Mapping[str, ca.SX],
        column: Mapping[str, ca.SX],
        unit: float,
    ) -> dict[str, ca.SX]:
        """An adjoint direction of the whole solution in the model's units, by its parts.

        `column` has its parts of v, t, lam and, with the exact Hessian, M; those of the states and
        costates follow from the dynamics and the adjoint recursion.
        """
        problem = self.problem
        n = problem.n_states
        m = problem.n_actions
        horizon = problem.horizon
        A = ca.horzsplit(qp["A"], n)
        B = ca.horzsplit(qp["B"], n)
        L = ca.horzsplit(qp["L"], n + m)
        v = ca.reshape(column["dv"], m, horizon)
        t = ca.reshape(column["dt"], n, horizon)
        lam = ca.reshape(column["dlam"], n, horizon)
        controls = ca.horzsplit(v)
        multipliers = ca.horzsplit(lam)

        # Forward by the dynamics from a state that is given, so does not move.
        xi = [ca.SX(n, 1)]
        for k in range(horizon):
            next_xi = A[k].T @ xi[k] + B[k].T @ controls[k]
            xi.append(next_xi)

        # Backward by the adjoint recursion; the state of stage k ≥ 1 has the row k−1.
        next_costate = qp["L_N"] @ xi[horizon] + multipliers[-1]
        chi = [next_costate]
        for k in reversed(range(horizon)):
            w = ca.vertcat(xi[k], controls[k])
            by_state = L[k] @ w
            costate = by_state[:n] + A[k] @ next_costate
            if k:
                costate += multipliers[k - 1]
            chi.insert(0, costate)
            next_costate = costate

        # From the QP's units to the model's, and from its unit right-hand side.
        scale = problem.scale
        state = ca.DM(scale.state)
        action = ca.DM(scale.action) * unit
        price = ca.DM(scale.state_price)
        d_xi = [part * state * unit for part in xi]
        d_chi = [part * price * unit for part in chi]
        direction = {
            "xi": ca.horzcat(*d_xi),
            "v": v * ca.repmat(action, 1, horizon),
            "t": t * ca.repmat(state * unit, 1, horizon),
            "lam": lam * ca.repmat(price * unit, 1, horizon),
            "chi": ca.horzcat(*d_chi),
        }
        if self.exact:
            direction["M"] = column["dM"]
        return direction


def _derivative_along(
    expression: ca.SX,
    variables: Iterable[ca.SX],
    direction: Iterable[ca.SX],
) -> ca.SX:
    """Directional derivative of an expression in these variables."""
    variable = ca.veccat(*variables)
    moved = ca.veccat(*direction)
    return ca.jtimes(expression, variable, moved)


def _call_symbols(inputs: Mapping[str, ca.SX]) -> dict[str, ca.MX]:
    """Symbols of the same names and shapes for a graph of calls."""
    return matrix_symbols({name: symbol.shape for name, symbol in inputs.items()})


def sensitivities(
    problem: Problem,
    blocks: ThetaBlocks,
    *,
    exact: bool,
) -> tuple[StackedFunction, Callable[[], StackedFunction]]:
    """Gradient of the value in θ, and a maker of its derivatives along the KKT adjoints.

    v, lam, the QP's matrices and the directions are in units of `Problem.scale`, all else in the
    model's (paper.tex, RTI Sensitivities).

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.
        exact: Whether the QP's Hessian holds the curvature of the model. Both functions then need
            M (see `_theta_lagrangian`) and χ̄, the costates where the curvature was taken, the
            second also dM, the directional derivative of M.

    Returns:
        A function of a solution (xi, v, t, lam, chi), the linearisation points x, u and theta,
        whose result is `gradient` (n_θ,). And what makes a second function, on its first call
        since it takes the longest to make and few ask for it. That is one of the same, the QP's
        A, B, L, L_N and the columns of m adjoint directions dv (mN, m), dt and dlam (nN, m); its
        results are `policy` (n_θ, m), dπ/dθ transposed, and `state` (n, m), dπ/ds transposed.
    """
    definitions = _definitions(problem, blocks, exact=exact)

    @cache
    def policy_jacobian() -> StackedFunction:
        return StackedFunction(definitions.policy_jacobian)

    return StackedFunction(definitions.value_gradient), policy_jacobian


@built_once
def _definitions(problem: Problem, blocks: ThetaBlocks, *, exact: bool) -> _Sensitivities:
    return _Sensitivities(problem, blocks, exact=exact)


def adjoint_directions(
    qp: SoftQp,
    solution: QpSolution,
    n_actions: int,
) -> tuple[Matrix, Matrix, Matrix]:
    """Solutions dv, dt, dλ of the KKT system for unit right-hand sides in u_0, a row an action.

    The KKT matrix of the active set is symmetric, so these rows of its inverse are all that dπ/dθ
    and dπ/ds need.

    Args:
        qp: The condensed QP with mN variables and nN rows.
        solution: Its solution.
        n_actions: Number of actions m.

    Returns:
        dv (m, mN), dt (m, nN) and dλ (m, nN).
    """
    active = solution.active(qp)
    # u_0 is the first of the variables.
    seeds = np.eye(n_actions, qp.f.size)
    unmoved_limits = np.zeros((n_actions, qp.w.size))
    dv, dlam = kkt_solve(qp, active, seeds, unmoved_limits)
    dt = np.zeros_like(dlam)
    violated = active.violated
    if violated.any():
        # The slack of a violated row moves with the row, and λ = ±(w + 2Wt) with the slack.
        row_change = dv @ qp.rows.T
        row_change = row_change[:, violated]
        curvature = 2 * qp.W[violated]
        side = np.sign(solution.lam[violated])
        dlam[:, violated] = curvature * row_change
        dt[:, violated] = side * row_change
    return dv, dt, dlam


def curvature_directions(
    rows: Matrix,
    dv: Matrix,
    step: Matrix,
    contract: Callable[[Matrix], Matrix],
    scale: Scale,
) -> Matrix:
    """Directional derivatives of M along the adjoint directions, (m, N(n+m)²).

    M is the contraction of ½ΔwΔwᵀ, so its derivative that of the symmetric part of Δw dwᵀ.

    Args:
        rows: Rows Γ of the QP, (nN, mN).
        dv: Adjoint directions, (m, mN).
        step: Δw of each stage from its point of linearisation in the model's units, (N, n+m).
        contract: Adjoint of the lift's derivative (`Spectrum.contract`).
        scale: Scale of the QP.
    """
    horizon, width = step.shape
    n = rows.shape[0] // horizon
    m = width - n
    # One unit of the scaled action's price, in the model's units.
    units = scale.action / scale.cost
    result = []
    for unit, row in zip(units, dv, strict=True):
        # dw of each stage. The rows are x_1 … x_N; x_0 is given and does not move, x_N is in no
        # stage.
        moved_states = rows @ row
        moved_states = moved_states.reshape(horizon, n)
        direction = np.zeros((horizon, width))
        direction[1:, :n] = moved_states[:-1]
        direction[:, n:] = row.reshape(horizon, m)
        direction *= scale.both * unit
        outer = _outer_products(step, direction)
        transposed = _outer_products(direction, step)
        symmetric = (outer + transposed) / 2
        dM = contract(symmetric)
        result.append(dM.reshape(-1))
    return np.array(result)


def _outer_products(first: Matrix, second: Matrix) -> Matrix:
    """Products a bᵀ (N, s, s) of the rows a and b of two matrices (N, s)."""
    columns = first[:, :, None]
    rows = second[:, None, :]
    return columns * rows
