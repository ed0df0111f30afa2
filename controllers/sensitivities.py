"""Sensitivities of the QP: dV/dθ, dQ/dθ and, along the KKT adjoints, dπ/dθ.

The QP's value has the gradient ∇θ of the QP's Lagrangian at the primal-dual solution y, and the
derivative of y is minus the inverse KKT matrix times ∇θ∇_y of that Lagrangian (paper.tex, RTI
Sensitivities). Both need one expression only: the part of the Lagrangian that contains θ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, cached_property

import casadi as ca
import numpy as np

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
from controllers.preparation import stage_parameter_gradient
from controllers.problem import Problem, Scale, built_once, of_kind
from controllers.qp import QpSolution, SoftQp, kkt_solve
from controllers.theta import (
    Symbols,
    ThetaBlocks,
    given_parts,
    given_size,
    moved_references,
    stage_columns,
    symbolic_theta,
)
from cosim.core.protocols import Matrix, Vector

SOLUTION_PARTS = ("xi", "t", "chi", "v", "lam")
"""First inputs of the sensitivities: a solution's parts."""


def _stage_lagrangian(
    problem: Problem,
    theta: Symbols,
    stage: Mapping[str, ca.SX],
) -> ca.SX:
    """A stage's terms of the QP's Lagrangian that hold θ, all but those of the model's p.

    Args:
        problem: The problem.
        theta: Symbols of θ (`symbolic_theta`).
        stage: What `_Sensitivities.stage` names, in the model's units.
    """
    # What does not hold θ has no part in the derivative, and is left out.
    B_l = theta["B_l"]
    w = ca.vertcat(stage["xi"], stage["v"])
    if "reference" in stage:
        w -= stage["reference"]
    cost = ca.dot(theta["b_l"], w)
    if "M" not in stage:
        cost += ca.bilin(B_l, w)
    else:
        # The cost expanded about the point, where B_l enters the lifted block by M too.
        about = ca.vertcat(stage["x"], stage["u"]) - problem.reference
        if "reference" in stage:
            about -= stage["reference"]
        cost += ca.bilin(B_l, about, 2 * w - about)
        cost += 2 * ca.dot(stage["M"], B_l)
    dynamics = ca.dot(stage["chi"], theta["c_f"])
    terms = stage["discount"] * cost + dynamics

    # The slack's price, which counts from stage 1 on.
    t = stage["t"]
    terms += stage["next_discount"] * ca.dot(theta["w_sigma"], t)
    terms += stage["next_discount"] * ca.dot(theta["W_sigma"], t**2)

    # λ is negative where a lower limit pushes, positive where an upper one does.
    lam = stage["lam"]
    from_below = ca.fmax(-lam, 0)
    from_above = ca.fmax(lam, 0)
    terms += ca.dot(from_below, theta["x_l"])
    terms -= ca.dot(from_above, theta["x_u"])
    return terms


def _quadratic_form(B: ca.SX, b: ca.SX, x: ca.SX) -> ca.SX:
    """xᵀBx + bᵀx, as θ has its costs: without a half."""
    return ca.bilin(B, x) + ca.dot(b, x)


class _Sensitivities:
    """Makes the gradient of the Lagrangian in θ and its derivatives, both by a sweep backward.

    A stage's part is a function of its own, called for each. It adds to the sum of the stages
    behind it, in the order in which one derivative of the whole Lagrangian would: the bits are the
    same.

    The QP's v, lam, matrices and directions are in units of `Problem.scale`, all else is in the
    model's.
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
        self.moves = bool(of_kind(problem.varying, "reference"))
        self.theta = symbolic_theta(problem, blocks)
        shapes = {
            "xi": (n, horizon + 1),
            "t": (n, horizon),
            "chi": (n, horizon + 1),
            "v": (m, horizon),
            "lam": (n, horizon),
            "x": (n, horizon),
            "u": (m, horizon),
            "theta": (given_size(problem, blocks), 1),
        }
        if exact:
            shapes["M"] = (n + m, horizon * (n + m))
            shapes["guess"] = (n, horizon)
        self.shapes: Shapes = shapes
        """Of the inputs of both functions."""

    def stage(self) -> dict[str, ca.SX]:
        """Symbols of a stage's part: w's ξ and v, the point x and u, what belongs to ξ_{k+1}.

        That are its slack t, λ and χ. `reference` is Δ_k, how far a reference has moved, and M the
        derivative of the second-order term by the block L_k of the exact Hessian, (n+m, n+m).
        """
        n = self.problem.n_states
        m = self.problem.n_actions
        shapes = {
            "xi": (n, 1),
            "t": (n, 1),
            "chi": (n, 1),
            "v": (m, 1),
            "lam": (n, 1),
            "x": (n, 1),
            "u": (m, 1),
            "discount": (1, 1),
            "next_discount": (1, 1),
        }
        if self.exact:
            shapes["M"] = (n + m, n + m)
        if self.moves:
            shapes["reference"] = (n + m, 1)
        return scalar_symbols(shapes)

    def _stages(self, inputs: Mapping[str, ca.MX]) -> list[dict[str, ca.MX]]:
        """The parts of `stage` of a solution, by stage."""
        problem = self.problem
        discounts = problem.discounts.tolist()
        references = self._references(inputs)
        columns = {name: ca.horzsplit(inputs[name]) for name in (*SOLUTION_PARTS, "x", "u")}
        if self.exact:
            columns["M"] = ca.horzsplit(inputs["M"], problem.n_states + problem.n_actions)
        stages = []
        for k in range(problem.horizon):
            stage = {name: by_stage[k] for name, by_stage in columns.items()}
            stage["chi"] = columns["chi"][k + 1]
            stage["discount"] = discounts[k]
            stage["next_discount"] = discounts[k + 1]
            if self.moves:
                stage["reference"] = references[k]
            stages.append(stage)
        return stages

    def _in_model_units(self, stage: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
        """A stage's part whose v and lam are in the QP's units, in the model's."""
        scale = self.problem.scale
        v = stage["v"] * ca.DM(scale.action)
        lam = stage["lam"] * ca.DM(scale.state_price)
        return {**stage, "v": v, "lam": lam}

    def _gradient(self, stage: Mapping[str, ca.SX], total: ca.SX) -> ca.SX:
        """The sum of gradients `total` with a stage's, whose part is in the model's units."""
        theta = self.theta["theta"]
        lagrangian = _stage_lagrangian(self.problem, self.theta, stage)
        # CasADi differentiates from the end: the sum comes first, and the stage is added to it.
        lagrangian += ca.dot(total, theta)
        return ca.gradient(lagrangian, theta)

    def _ends(self) -> dict[str, ca.SX]:
        """Symbols of ξ_0 and of ξ_N less what the terminal cost's reference has moved."""
        n = self.problem.n_states
        return scalar_symbols({"first_xi": (n, 1), "last_xi": (n, 1)})

    def _ends_gradient(self, ends: Mapping[str, ca.SX]) -> ca.SX:
        """∇θ of the initial cost λ_θ(ξ_0) and of the terminal one, γᴺ V^f_θ(ξ_N)."""
        theta = self.theta
        end_discount = self.problem.discount**self.problem.horizon
        terms = _quadratic_form(theta["B_lambda"], theta["b_lambda"], ends["first_xi"])
        terms += theta["c_lambda"]
        terms += end_discount * _quadratic_form(theta["B_Vf"], theta["b_Vf"], ends["last_xi"])
        return ca.gradient(terms, theta["theta"])

    def _ends_of(self, inputs: Mapping[str, ca.MX]) -> dict[str, ca.MX]:
        """The parts of `_ends` of a solution."""
        xi = ca.horzsplit(inputs["xi"])
        last_xi = xi[-1]
        if self.moves:
            last_xi -= self._references(inputs)[-1][: self.problem.n_states]
        return {"first_xi": xi[0], "last_xi": last_xi}

    def _references(self, inputs: Mapping[str, ca.MX]) -> list[ca.MX]:
        """Distance of the cost's reference from the problem's at the stages 0 … N."""
        parts = given_parts(self.problem, self.blocks, inputs["theta"])
        return moved_references(self.problem, parts["sigma"])

    @cached_property
    def value_gradient(self) -> Definition:
        """dV/dθ or dQ/dθ: the Lagrangian's gradient at a solution."""
        stage = self.stage()
        total = ca.SX.sym("total", self.blocks.size)
        gradient = self._gradient(self._in_model_units(stage), total)
        add_stage = sweep_function(
            "add_stage_gradient",
            {**stage, "total": total},
            {"sum": gradient},
        )
        ends = self._ends()
        ends_gradient = sweep_function(
            "ends_gradient",
            ends,
            {"gradient": self._ends_gradient(ends)},
        )

        inputs = matrix_symbols(self.shapes)
        sum_of_stages = call(ends_gradient, **self._ends_of(inputs))["gradient"]
        for part in reversed(self._stages(inputs)):
            sum_of_stages = call(add_stage, **part, total=sum_of_stages)["sum"]
        if "p" in self.blocks:
            by_stage = self._stage_gradient.map(self.problem.horizon)
            gradients = by_stage(*self._stage_arguments(inputs))
            sum_of_stages[self._parameters] = ca.sum2(gradients)
        return define("value_gradient", inputs, {"gradient": sum_of_stages})

    @cached_property
    def policy_jacobian(self) -> Definition:
        """dπ/dθ and dπ/ds, transposed: derivatives of the gradient along the KKT adjoints.

        An adjoint direction moves v, t, lam and, with the exact Hessian, M; how it moves the states
        follows from the dynamics, forward, and the costates from the adjoint recursion, backward.
        """
        problem = self.problem
        n = problem.n_states
        m = problem.n_actions
        horizon = problem.horizon
        block = (n + m) ** 2
        shapes = {
            **self.shapes,
            "A": (n, n * horizon),
            "B": (m, n * horizon),
            "L": (n + m, horizon * (n + m)),
            "L_N": (n, n),
            "dv": (m * horizon, m),
            "dt": (n * horizon, m),
            "dlam": (n * horizon, m),
        }
        if self.exact:
            shapes["dM"] = (block * horizon, m)
        inputs = matrix_symbols(shapes)
        A = ca.horzsplit(inputs["A"], n)
        B = ca.horzsplit(inputs["B"], n)
        L = ca.horzsplit(inputs["L"], n + m)
        rows = {"dv": m, "dt": n, "dlam": n}
        if self.exact:
            rows["dM"] = block
        directions = []
        for k in range(horizon):
            of_stage = {}
            for name, count in rows.items():
                of_stage[name] = inputs[name][k * count : (k + 1) * count, :]
            directions.append(of_stage)

        # Forward from a state that is given, so does not move.
        move = self._moved_state()
        dxi = [ca.MX.zeros(n, m)]
        for k in range(horizon):
            next_dxi = move(A[k], B[k], dxi[k], directions[k]["dv"])
            dxi.append(next_dxi)

        end = self._moved_end()
        of_end = call(end, **self._ends_of(inputs), L_N=inputs["L_N"], dxi=dxi[horizon])
        total = of_end["gradient"]
        by_next_state = of_end["by_state"]
        stages = self._stages(inputs)
        moved: list[dict[str, ca.MX]] = []
        add_stage = self._moved_stage()
        for k in reversed(range(horizon)):
            of_stage = call(
                add_stage,
                **stages[k],
                **directions[k],
                A=A[k],
                L=L[k],
                dxi=dxi[k],
                by_next_state=by_next_state,
                total=total,
            )
            total = of_stage["sum"]
            by_next_state = of_stage["by_state"]
            moved.insert(0, of_stage)
        # dy/dθ is minus the inverse KKT matrix times ∇θ∇_y: hence the sign.
        policy = -total
        if "p" in self.blocks:
            policy[self._parameters, :] = -self._moved_parameters(inputs, moved, directions)
        price = ca.repmat(ca.DM(problem.scale.state_price), 1, m)
        units = ca.repmat(ca.DM(self._units).T, n, 1)
        results = {
            "policy": policy,
            "state": -(by_next_state * price * units),
        }
        return define("policy_jacobian", inputs, results)

    @property
    def _units(self) -> Vector:
        """One unit of each scaled action's price in the model's units: the right-hand sides'."""
        scale = self.problem.scale
        return scale.action / scale.cost

    def _moved_state(self) -> ca.Function:
        """dξ_{k+1} (n, m) from A_kᵀ, B_kᵀ, dξ_k and dv_k, a column a direction."""
        n = self.problem.n_states
        m = self.problem.n_actions
        symbols = scalar_symbols(
            {
                "A": (n, n),
                "B": (m, n),
                "dxi": (n, m),
                "dv": (m, m),
            }
        )
        next_dxi = symbols["A"].T @ symbols["dxi"] + symbols["B"].T @ symbols["dv"]
        return stage_function("moved_state", symbols, {"next_dxi": next_dxi})

    def _moved_end(self) -> ca.Function:
        """The ends' part of the derivatives in θ, and dχ_N without its soft row's λ."""
        problem = self.problem
        n = problem.n_states
        m = problem.n_actions
        state_scale = ca.DM(problem.scale.state)
        ends = self._ends()
        directions = scalar_symbols({"L_N": (n, n), "dxi": (n, m)})
        gradient = self._ends_gradient(ends)
        derivatives = []
        for i in range(m):
            along = directions["dxi"][:, i] * state_scale * self._units[i]
            derivatives.append(_derivative_along(gradient, [ends["last_xi"]], [along]))
        results = {
            "gradient": ca.horzcat(*derivatives),
            "by_state": directions["L_N"] @ directions["dxi"],
        }
        return sweep_function("moved_end", {**ends, **directions}, results)

    def _moved_stage(self) -> ca.Function:
        """Adds a stage's part to the derivatives in θ, and goes from dχ_{k+1} to dχ_k.

        Its arguments are those of a stage, and a column for each direction: dξ, dv, dt, dλ and, if
        exact, dM; all of dχ_{k+1} but its soft row's λ; the sum of the stages behind it. With the
        model's parameters in θ it gives dw and dχ_{k+1} in the model's units, side by side, too.
        """
        problem = self.problem
        scale = problem.scale
        n = problem.n_states
        m = problem.n_actions
        stage = self.stage()
        shapes = {
            "A": (n, n),
            "L": (n + m, n + m),
            "dxi": (n, m),
            "dv": (m, m),
            "dt": (n, m),
            "dlam": (n, m),
            "by_next_state": (n, m),
            "total": (self.blocks.size, m),
        }
        if self.exact:
            shapes["dM"] = ((n + m) ** 2, m)
        directions = scalar_symbols(shapes)
        dchi = directions["by_next_state"] + directions["dlam"]

        # Symbols of the solution in the model's units: those along which the directions are.
        unscaled = {**stage, **scalar_symbols({"v": (m, 1), "lam": (n, 1)})}
        total = ca.SX.sym("sum", self.blocks.size)
        gradient = self._gradient(unscaled, total)
        moving = ["xi", "v", "t", "lam", "chi"]
        if self.exact:
            moving.append("M")
        variables = [unscaled[name] for name in moving]
        sums = []
        steps = []
        costates = []
        for i in range(m):
            # From the QP's units to the model's, and from its unit right-hand side.
            unit = float(self._units[i])
            action = ca.DM(scale.action) * unit
            along = {
                "xi": directions["dxi"][:, i] * ca.DM(scale.state) * unit,
                "v": directions["dv"][:, i] * action,
                "t": directions["dt"][:, i] * ca.DM(scale.state * unit),
                "lam": directions["dlam"][:, i] * ca.DM(scale.state_price * unit),
                "chi": dchi[:, i] * ca.DM(scale.state_price) * unit,
            }
            if self.exact:
                along["M"] = directions["dM"][:, i]
            derivative = _derivative_along(
                gradient,
                [*variables, total],
                [*along.values(), directions["total"][:, i]],
            )
            sums.append(derivative)
            steps.append(ca.vertcat(along["xi"], along["v"]))
            costates.append(along["chi"])

        # The QP's own numbers come as they are, so the conversion is part of the function.
        in_units = self._in_model_units(stage)
        (sum_of_stages,) = ca.substitute(
            [ca.horzcat(*sums)],
            [unscaled["v"], unscaled["lam"]],
            [in_units["v"], in_units["lam"]],
        )
        by_w = directions["L"] @ ca.vertcat(directions["dxi"], directions["dv"])
        results = {
            "sum": sum_of_stages,
            "by_state": by_w[:n, :] + directions["A"] @ dchi,
        }
        if "p" in self.blocks:
            results["dw"] = ca.horzcat(*steps)
            results["dchi"] = ca.horzcat(*costates)
        return sweep_function("moved_stage", {**stage, **directions}, results)

    def _moved_parameters(
        self,
        inputs: Mapping[str, ca.MX],
        moved: Sequence[Mapping[str, ca.MX]],
        directions: Sequence[Mapping[str, ca.MX]],
    ) -> ca.MX:
        """The derivatives' rows of the model's parameters p, (n_p, m), from the stages' gradients.

        Args:
            inputs: The function's inputs.
            moved: `dw` and `dchi` of each stage.
            directions: `dM` of each stage, if exact.
        """
        m = self.problem.n_actions
        along = [
            ca.horzcat(*[stage["dw"] for stage in moved]),
            ca.horzcat(*[stage["dchi"] for stage in moved]),
        ]
        if self.exact:
            along.append(ca.horzcat(*[direction["dM"] for direction in directions]))
        stages = self._moved_parameter_gradient().map(self.problem.horizon)
        by_stage = stages(*self._stage_arguments(inputs), *along)
        # A column a stage, in which those of the directions are one below the other.
        count = by_stage.size1()
        columns = ca.reshape(by_stage, count * m, self.problem.horizon)
        return ca.reshape(ca.sum2(columns), count, m)

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
        w = ca.vertcat(xi[:, :-1], v) + reference
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
        """Derivatives (n_p, m) of `stage_parameter_gradient` along directions of w, χ and M."""
        m = self.problem.n_actions
        stage = self._stage_gradient
        shapes = {name: stage.size_in(name) for name in stage.name_in()}
        arguments = scalar_symbols(shapes)
        moving = ["w", "chi"]
        if self.exact:
            moving.append("M")
        variables = [arguments[name] for name in moving]
        # A column a direction.
        along = scalar_symbols({f"d{symbol}": (arguments[symbol].numel(), m) for symbol in moving})

        gradient = stage(*arguments.values())
        derivatives = []
        for i in range(m):
            direction = [part[:, i] for part in along.values()]
            derivatives.append(_derivative_along(gradient, variables, direction))
        return stage_function(
            "moved_parameter_gradient",
            {**arguments, **along},
            {"derivative": ca.horzcat(*derivatives)},
        )


def _derivative_along(
    expression: ca.SX,
    variables: Iterable[ca.SX],
    direction: Iterable[ca.SX],
) -> ca.SX:
    """Directional derivative of an expression in these variables."""
    variable = ca.veccat(*variables)
    moved = ca.veccat(*direction)
    return ca.jtimes(expression, variable, moved)


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
            M (see `_Sensitivities.stage`) and χ̄, the costates where the curvature was taken, the
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
