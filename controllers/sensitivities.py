"""Sensitivities of the QP: dV/dθ, dQ/dθ and, along the KKT adjoints, dπ/dθ.

The QP's value has the gradient ∇θ of the QP's Lagrangian at the primal-dual solution y, and the
derivative of y is minus the inverse KKT matrix times ∇θ∇_y of that Lagrangian (paper.tex, RTI
Sensitivities). Both need one expression only: the part of the Lagrangian that contains θ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

import casadi as ca
import numpy as np

from controllers.functions import StackedFunction
from controllers.preparation import stage_function, stage_parameter_gradient
from controllers.problem import Problem, Scale
from controllers.qp import QpSolution, SoftQp, kkt_solve
from controllers.theta import Symbols, ThetaBlocks, symbolic_theta
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
        symbols: θ's symbols (`symbolic_theta`).
        y: Solution in the model's units: `xi` and `chi` (n, N+1), `v` (m, N), the slack `t` and
            the rows' multipliers `lam` (n, N).
        points: Points of linearisation (x, u) in the model's units, (n+m, N).
        M: Derivatives of the second-order term by the blocks L_k of the exact Hessian, side by
            side, (n+m, N(n+m)); None where the Hessian is the cost's own.
    """
    horizon = problem.horizon
    gamma = problem.discount
    xi = ca.horzsplit(y["xi"])
    chi = ca.horzsplit(y["chi"])
    v = ca.horzsplit(y["v"])
    t = ca.horzsplit(y["t"])
    lam = ca.horzsplit(y["lam"])
    M_k = None if M is None else ca.horzsplit(M, points.size1())

    terms = ca.bilin(symbols["B_lambda"], xi[0]) + ca.dot(symbols["b_lambda"], xi[0])
    terms += symbols["c_lambda"]
    for k in range(horizon):
        w = ca.vertcat(xi[k], v[k])
        stage = ca.dot(symbols["b_l"], w)
        if M_k is None:
            stage += ca.bilin(symbols["B_l"], w)
        else:
            # The cost expanded about the point, where B_l enters the lifted block by M too.
            point = points[:, k] - problem.reference
            stage += ca.bilin(symbols["B_l"], point, 2 * w - point)
            stage += 2 * ca.dot(M_k[k], symbols["B_l"])
        terms += gamma**k * stage + ca.dot(chi[k + 1], symbols["c_f"])
        terms += gamma ** (k + 1) * ca.dot(symbols["w_sigma"], t[k])
        terms += gamma ** (k + 1) * ca.dot(symbols["W_sigma"], t[k] ** 2)
        # λ is negative where a lower limit pushes, positive where an upper one does.
        terms += ca.dot(ca.fmax(-lam[k], 0), symbols["x_l"])
        terms -= ca.dot(ca.fmax(lam[k], 0), symbols["x_u"])
    end = xi[horizon]
    terminal = ca.bilin(symbols["B_Vf"], end) + ca.dot(symbols["b_Vf"], end)
    return terms + gamma**horizon * terminal


class _Sensitivities:
    """Symbols and the Lagrangian's gradient in θ, of which both functions are made.

    The QP's v, lam and matrices are inputs in units of `Problem.scale`, all else is in the model's;
    `y` are the symbols of a solution in the model's units, in which the Lagrangian is written.
    """

    def __init__(self, problem: Problem, blocks: ThetaBlocks, *, exact: bool) -> None:
        n = problem.n_states
        m = problem.n_actions
        horizon = problem.horizon
        self.problem = problem
        self.blocks = blocks
        self.exact = exact
        self.symbols = symbolic_theta(problem, blocks)
        self.y = {
            "xi": ca.SX.sym("xi", n, horizon + 1),
            "v": ca.SX.sym("v", m, horizon),
            "t": ca.SX.sym("t", n, horizon),
            "lam": ca.SX.sym("lam", n, horizon),
            "chi": ca.SX.sym("chi", n, horizon + 1),
        }
        self.scaled = {
            "v": ca.SX.sym("v", m, horizon),
            "lam": ca.SX.sym("lam", n, horizon),
        }
        self.x = ca.SX.sym("x", n, horizon)
        self.u = ca.SX.sym("u", m, horizon)
        self.M = ca.SX.sym("M", n + m, horizon * (n + m))
        self.guess = ca.SX.sym("guess", n, horizon)

        points = ca.vertcat(self.x, self.u)
        M = self.M if exact else None
        lagrangian = _theta_lagrangian(problem, self.symbols, self.y, points, M)
        self.gradient = ca.gradient(lagrangian, self.symbols["theta"])
        """All of it but the part of p, which is a sum of a function of one stage."""

        solution = {name: self.y[name] for name in SOLUTION_PARTS} | self.scaled
        self.inputs = {**solution, "x": self.x, "u": self.u, "theta": self.symbols["theta"]}
        if exact:
            self.inputs |= {"M": self.M, "guess": self.guess}

    def in_scaled_units(self, expression: ca.SX) -> ca.SX:
        """The expression of v and lam in the model's units as one of the scaled ones."""
        scale = self.problem.scale
        horizon = self.problem.horizon
        v = self.scaled["v"] * ca.repmat(ca.DM(scale.action), 1, horizon)
        lam = self.scaled["lam"] * ca.repmat(ca.DM(scale.state_price), 1, horizon)
        return ca.substitute([expression], [self.y["v"], self.y["lam"]], [v, lam])[0]

    def value_gradient(self) -> StackedFunction:
        """dV/dθ or dQ/dθ: the Lagrangian's gradient at a solution."""
        results = {"gradient": self.in_scaled_units(self.gradient)}
        if "p" not in self.blocks:
            return StackedFunction("value_gradient", self.inputs, results)
        # A stage's gradient is called: written out for each stage its C takes minutes to compile.
        rest = stage_function("value_gradient_rest", self.inputs, results)
        stage = stage_parameter_gradient(self.problem, self.blocks, exact=self.exact)
        symbols = _call_symbols(self.inputs)
        arguments = self._stage_arguments(symbols)
        stages = stage.map(self.problem.horizon)(*arguments)
        gradient = rest(*symbols.values())
        gradient[self.blocks.slices["p"]] = ca.sum2(stages)
        return StackedFunction("value_gradient", symbols, {"gradient": gradient})

    def policy_jacobian(self) -> StackedFunction:
        """dπ/dθ and dπ/ds, transposed: derivatives of the gradient along the KKT adjoints."""
        problem = self.problem
        n = problem.n_states
        m = problem.n_actions
        horizon = problem.horizon
        width = n + m
        qp = {
            "A": ca.SX.sym("A", n, n * horizon),
            "B": ca.SX.sym("B", m, n * horizon),
            "L": ca.SX.sym("L", width, horizon * width),
            "L_N": ca.SX.sym("L_N", n, n),
        }
        directions = {
            "dv": ca.SX.sym("dv", m * horizon, m),
            "dt": ca.SX.sym("dt", n * horizon, m),
            "dlam": ca.SX.sym("dlam", n * horizon, m),
        }
        differentiated = list(self.y.values())
        if self.exact:
            directions["dM"] = ca.SX.sym("dM", width * horizon * width, m)
            differentiated.append(self.M)

        policy = []
        by_state = []
        moved: dict[str, ca.SX] = {}
        for i in range(m):
            column = {name: direction[:, i] for name, direction in directions.items()}
            # In the model's units: the right-hand side was one unit of the scaled action's price.
            unit = float(problem.scale.action[i] / problem.scale.cost)
            direction = self._direction(qp, column, unit)
            moved_solution = ca.veccat(*direction.values())
            derivative = ca.jtimes(self.gradient, ca.veccat(*differentiated), moved_solution)
            policy.append(-self.in_scaled_units(derivative))
            by_state.append(-direction["chi"][:, 0])
            moved[f"w_{i}"] = ca.vertcat(direction["xi"][:, :horizon], direction["v"])
            moved[f"chi_{i}"] = direction["chi"][:, 1:]
        inputs = {**self.inputs, **qp, **directions}
        results = {"policy": ca.horzcat(*policy), "state": ca.horzcat(*by_state)}
        if "p" not in self.blocks:
            return StackedFunction("policy_jacobian", inputs, results)

        rest = stage_function("policy_jacobian_rest", inputs, {**results, **moved})
        stage = self._moved_parameter_gradient().map(horizon)
        symbols = _call_symbols(inputs)
        arguments = self._stage_arguments(symbols)
        parts = dict(zip(rest.name_out(), rest(*symbols.values()), strict=True))
        for i in range(m):
            along = [parts[f"w_{i}"], parts[f"chi_{i}"]]
            if self.exact:
                along.append(ca.reshape(symbols["dM"][:, i], width, horizon * width))
            of_stages = stage(*arguments, *along)
            parts["policy"][self.blocks.slices["p"], i] = -ca.sum2(of_stages)
        whole = {name: parts[name] for name in ("policy", "state")}
        return StackedFunction("policy_jacobian", symbols, whole)

    def _stage_arguments(self, symbols: Mapping[str, ca.MX]) -> list[ca.MX]:
        """Arguments of `stage_parameter_gradient`, those of stage 0, 1, … side by side."""
        problem = self.problem
        horizon = problem.horizon
        v = symbols["v"] * ca.repmat(ca.DM(problem.scale.action), 1, horizon)
        w = ca.vertcat(symbols["xi"][:, :horizon], v)
        w += ca.repmat(ca.DM(problem.reference), 1, horizon)
        theta = ca.repmat(symbols["theta"], 1, horizon)
        arguments = [symbols["x"], symbols["u"], theta, w, symbols["chi"][:, 1:]]
        if self.exact:
            arguments += [symbols["M"], symbols["guess"]]
        return arguments

    def _moved_parameter_gradient(self) -> ca.Function:
        """Directional derivative of `stage_parameter_gradient` in w, χ and, if exact, M."""
        stage = stage_parameter_gradient(self.problem, self.blocks, exact=self.exact)
        arguments = {
            name: ca.SX.sym(name, *stage.size_in(i)) for i, name in enumerate(stage.name_in())
        }
        names = ("w", "chi", "M") if self.exact else ("w", "chi")
        along = {f"d{name}": ca.SX.sym(f"d{name}", *arguments[name].shape) for name in names}
        variables = ca.veccat(*(arguments[name] for name in names))
        derivative = ca.jtimes(stage(*arguments.values()), variables, ca.veccat(*along.values()))
        inputs = {**arguments, **along}
        return stage_function("moved_parameter_gradient", inputs, {"derivative": derivative})

    def _direction(
        self, qp: Mapping[str, ca.SX], column: Mapping[str, ca.SX], unit: float
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

        xi = [ca.SX(n, 1)]
        for k in range(horizon):
            xi.append(A[k].T @ xi[k] + B[k].T @ v[:, k])
        chi = [qp["L_N"] @ xi[horizon] + lam[:, horizon - 1]]
        for k in reversed(range(horizon)):
            costate = L[k][:n, :] @ ca.vertcat(xi[k], v[:, k]) + A[k] @ chi[0]
            chi.insert(0, costate + (lam[:, k - 1] if k else 0))

        state = ca.DM(problem.scale.state)
        action = ca.DM(problem.scale.action)
        price = ca.DM(problem.scale.state_price)
        direction = {
            "xi": ca.horzcat(*(part * state * unit for part in xi)),
            "v": v * ca.repmat(action * unit, 1, horizon),
            "t": t * ca.repmat(state * unit, 1, horizon),
            "lam": lam * ca.repmat(price * unit, 1, horizon),
            "chi": ca.horzcat(*(part * price * unit for part in chi)),
        }
        if self.exact:
            direction["M"] = column["dM"]
        return direction


def _call_symbols(inputs: Mapping[str, ca.SX]) -> dict[str, ca.MX]:
    """Symbols of the same names and shapes for a graph of calls."""
    return {name: ca.MX.sym(name, *symbol.shape) for name, symbol in inputs.items()}


def sensitivities(
    problem: Problem, blocks: ThetaBlocks, *, exact: bool
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
    made = _Sensitivities(problem, blocks, exact=exact)
    return made.value_gradient(), cache(made.policy_jacobian)


def adjoint_directions(
    qp: SoftQp, solution: QpSolution, n_actions: int
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
    seeds = np.eye(n_actions, qp.f.size)
    dv, dlam = kkt_solve(qp, active, seeds, np.zeros((n_actions, qp.w.size)))
    dt = np.zeros_like(dlam)
    violated = active.violated
    if violated.any():
        # The slack of a violated row moves with the row, and λ = ±(w + 2Wt) with the slack.
        row_change = (dv @ qp.rows.T)[:, violated]
        dlam[:, violated] = 2 * qp.W[violated] * row_change
        dt[:, violated] = np.sign(solution.lam[violated]) * row_change
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
    result = []
    for unit, row in zip(scale.action / scale.cost, dv, strict=True):
        direction = np.zeros((horizon, width))
        # The rows are x_1 … x_N; x_0 is given and does not move, x_N is in no stage.
        direction[1:, :n] = (rows @ row).reshape(horizon, n)[:-1]
        direction[:, n:] = row.reshape(horizon, width - n)
        direction *= scale.both * unit
        outer = step[:, :, None] * direction[:, None, :]
        transposed = direction[:, :, None] * step[:, None, :]
        result.append(contract((outer + transposed) / 2).reshape(-1))
    return np.array(result)
