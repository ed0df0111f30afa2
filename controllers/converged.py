"""NMPC solved to convergence: SQP on the RTI's own QP, globalised by a line search."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from controllers.errors import QpError
from controllers.functions import StackedFunction
from controllers.problem import Problem
from controllers.qp import NOT_CONVEX, QpBackend, QpSolution, SoftQp
from controllers.rti import RtiNmpc
from controllers.rti.nmpc import LinearisationPoint, RtiSolution
from controllers.rti.preparation import sampled_jacobian
from controllers.theta import Parameters, SymbolicTheta, ThetaBlocks
from cosim.protocols import Vector
from cosim.validation import known_keywords


def merit(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """The programme of paper.tex eq. param_nmpc with x_0 = s, for an ℓ1 merit function.

    Inputs: the state s (n), the states x_1 … x_N and controls u, absolute, (n, N), (m, N), theta.
    Results: the `gradient` (N(n+m), states first) of `cost`, which is all but the `penalty` of the
    predicted states, and `infeasibility` ‖f_θ(x_k, u_k) − x_{k+1}‖₁.
    """
    n, m, horizon, gamma = problem.n_states, problem.n_actions, problem.horizon, problem.discount
    symbols = SymbolicTheta.of(problem, blocks)
    s, x, u = ca.SX.sym("s", n), ca.SX.sym("x", n, horizon), ca.SX.sym("u", m, horizon)
    x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
    states = ca.horzcat(s, x)
    cost = problem.symbolic_penalty(s) + symbols["c_lambda"]
    cost += ca.bilin(symbols["B_lambda"], s - x_s) + ca.dot(symbols["b_lambda"], s - x_s)
    penalty, defects = ca.SX(0), []
    for k in range(horizon):
        w = ca.vertcat(states[:, k] - x_s, u[:, k] - u_s)
        cost += gamma**k * (ca.bilin(symbols["B_l"], w) + ca.dot(symbols["b_l"], w))
        x_next, _ = sampled_jacobian(problem, states[:, k], u[:, k], symbols.model_parameters)
        defects.append(x_next + symbols["c_f"] - states[:, k + 1])
        slack = ca.fmax(ca.fmax(symbols["x_l"] - x[:, k], x[:, k] - symbols["x_u"]), 0)
        penalty += gamma ** (k + 1) * ca.dot(symbols["w_sigma"], slack)
        penalty += gamma ** (k + 1) * ca.dot(symbols["W_sigma"], slack**2)
    end = x[:, horizon - 1] - x_s
    cost += gamma**horizon * (ca.bilin(symbols["B_Vf"], end) + ca.dot(symbols["b_Vf"], end))
    return StackedFunction(
        "merit",
        {"s": s, "x": x, "u": u, "theta": symbols.theta},
        {
            "gradient": ca.gradient(cost, ca.veccat(x, u)),
            "cost": cost,
            "penalty": penalty,
            "infeasibility": ca.sum1(ca.fabs(ca.veccat(*defects))),
        },
    )


class _Known(NamedTuple):
    """A backend that returns the solution it is given: to read out a QP already solved."""

    solution: QpSolution

    def load(self, qp: SoftQp) -> None: ...

    def solve(self, qp: SoftQp) -> QpSolution:
        return self.solution


class _Measured(NamedTuple):
    """Of a point `cost` and its `gradient`, the states' `penalty`, `infeasibility` ‖defects‖₁."""

    cost: float
    penalty: float
    infeasibility: float
    gradient: Vector

    def merit(self, weight: float) -> float:
        return self.cost + self.penalty + weight * self.infeasibility


class ConvergedNmpc(RtiNmpc):
    """The NMPC of `RtiNmpc` with every programme solved to convergence; same θ, same read-outs.

    Q, V, π and their sensitivities are those of the nonlinear programme (paper.tex, Sensitivities
    of Fully Converged NMPC): at the solution the QP with the exact Hessian has the programme's KKT
    matrix. SQP on that QP converges quadratically; where it is not convex the Hessian is lifted,
    and an ℓ1 merit function chooses the step length. `tolerance` is on the largest change of
    states, actions and, relative to 1 + ‖χ‖∞, costates; QpError where `iterations` do not reach it.
    """

    name = "converged"
    memoryless = False
    """A feedback depends on earlier ones: it starts its SQP where the last one ended."""

    @known_keywords
    def __init__(
        self,
        problem: Problem,
        parameters: Parameters,
        *,
        backend: str | Callable[[], QpBackend] = "daqp",
        tolerance: float = 1e-9,
        iterations: int = 100,
    ) -> None:
        self._tolerance, self._patience = tolerance, iterations
        self._merit = merit(problem, parameters.blocks)
        super().__init__(problem, parameters, hessian="exact", backend=backend)

    def _linearise(self) -> None:
        """Prepare the QP of the exact Hessian, or of the lifted one if the backend refuses it."""
        try:
            self._linearise_as(lifts=False)
        except QpError as error:
            if error.status != NOT_CONVEX:
                raise
            self._linearise_as(lifts=True)

    def _linearise_as(self, *, lifts: bool) -> None:
        self._hessian.lifts = lifts
        super()._linearise()

    def _solve_qp(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        """Solve the prepared QP; the lifted one in its place where it is not convex."""
        try:
            return super()._solve_qp(s, a)
        except QpError as error:
            if error.status != NOT_CONVEX or self._hessian.lifts:
                raise
        self._linearise_as(lifts=True)
        return super()._solve_qp(s, a)

    def _solve(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        solution = self._solve_qp(s, a)
        x, u, _ = self.linearisation_point
        # The programme's x_0 is s; the guess for the other states and controls is the prepared one.
        at = np.vstack([np.asarray(s, dtype=np.float64), x[1:], solution.predicted_states[-1:]])
        controls = u if a is None else np.vstack([a, u[1:]])
        weight, measured = 0.0, None
        for _ in range(self._patience):
            weight = max(weight, 1.5 * float(np.abs(solution.costates).max()))
            states, actions = solution.predicted_states, solution.predicted_actions
            if measured is None:
                at, controls = states, actions
                measured = self._measure(at, controls)
            else:
                at, controls, measured = self._search(
                    at, controls, states - at, actions - controls, weight, measured
                )
            before = self._costates.copy()
            self._linearise_at(LinearisationPoint(at[:-1], controls, solution.costates[1:]))
            solution = self._solve_qp(s, a)
            change = max(
                float(np.abs(solution.predicted_states - at).max()),
                float(np.abs(solution.predicted_actions - controls).max()),
                float(np.abs(solution.costates[1:] - self._costates).max())
                / (1 + float(np.abs(before).max())),
            )
            if change < self._tolerance:
                return self._read_out(s, a, solution) if self._hessian.lifts else solution
        raise QpError(
            f"SQP did not converge in {self._patience} iterations at s = {at[0]}; "
            f"last change {change:.1e}",
            status="not converged",
            qp=solution.qp.copy(),
        )

    def _search(
        self,
        at: Vector,
        controls: Vector,
        step: Vector,
        turn: Vector,
        weight: float,
        here: _Measured,
    ) -> tuple[Vector, Vector, _Measured]:
        """The point by the largest of 1, ½, ¼, … that gives the merit a sufficient decrease."""
        move = np.concatenate([step[1:].reshape(-1), turn.reshape(-1)])
        trial = end = self._measure(at + step, controls + turn)
        slope = float(here.gradient @ move) + end.penalty - here.penalty
        slope -= weight * here.infeasibility
        start, length = here.merit(weight), 1.0
        # Rounding of values near 1e6 must not stop the last steps.
        rounding = 1e-12 * abs(start)
        while length > 1e-6:
            if trial.merit(weight) <= start + 1e-4 * length * min(slope, 0.0) + rounding:
                break
            length /= 2
            trial = self._measure(at + length * step, controls + length * turn)
        return at + length * step, controls + length * turn, trial

    def _measure(self, at: Vector, controls: Vector) -> _Measured:
        function = self._merit
        function.inputs["s"][:], function.inputs["x"][:] = at[0], at[1:].reshape(-1)
        function.inputs["u"][:] = controls.reshape(-1)
        function.inputs["theta"][:] = self.theta
        function()
        cost, penalty, infeasibility = function.stack[-3:].tolist()
        return _Measured(cost, penalty, infeasibility, function.part("gradient").copy())

    def _read_out(self, s: ArrayLike, a: ArrayLike | None, solution: RtiSolution) -> RtiSolution:
        """Read a lifted QP's solution out of the programme's own QP, which need not be convex."""
        backend, self._backend = self._backend, _Known(solution.multipliers)
        try:
            self._linearise_at(solution.unshifted)
            return super()._solve_qp(s, a)
        finally:
            self._backend = backend
            self._linearise_as(lifts=True)
