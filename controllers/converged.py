"""NMPC solved to convergence: SQP on the RTI's own QP, globalised by a line search."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.buffered import BufferedFunction
from controllers.errors import QpError
from controllers.ocp import merit
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.qp import QpBackend, QpSolution, SoftQp
from controllers.rti import RtiNmpc
from controllers.rti.solution import LinearisationPoint, RtiSolution

Vector = NDArray[np.float64]


class _Known:
    """A backend that returns the solution it is given: to read out a QP already solved."""

    solution: QpSolution

    def load(self, qp: SoftQp) -> None:
        """Do nothing."""

    def solve(self, qp: SoftQp) -> QpSolution:
        """Return the known solution."""
        return self.solution


class ConvergedNmpc(RtiNmpc):
    """The NMPC of `RtiNmpc` with every programme solved to convergence; same θ, same read-outs.

    Q, V and π are those of the nonlinear programme, and so are their sensitivities (paper.tex,
    Sensitivities of Fully Converged NMPC): at the solution the QP with the exact Hessian has the
    KKT matrix of the programme, so its read-outs are the programme's. SQP iterates on convexified
    QPs; an ℓ1 merit function chooses the step length. `tolerance` is on the largest change of
    states, actions and, relative to 1 + ‖χ‖∞, costates; QpError is raised where `iterations` do
    not reach it.
    """

    name = "converged"

    def __init__(
        self,
        problem: Problem,
        parameters: Parameters,
        *,
        backend: str | Callable[[], QpBackend] = "daqp",
        tolerance: float = 1e-9,
        iterations: int = 100,
    ) -> None:
        """Build the functions; see the class."""
        self._tolerance, self._iterations = tolerance, iterations
        self._merit = merit(problem, parameters.blocks)
        self._known = _Known()
        self._programme = RtiNmpc(
            problem, parameters, hessian="exact-unlifted", backend=lambda: self._known
        )
        super().__init__(problem, parameters, hessian="exact", backend=backend)

    def _compilable(self) -> list[BufferedFunction]:
        return [*super()._compilable(), self._merit]

    def _solve(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        solution = super()._solve(s, a)
        x, u, _ = self.linearisation_point
        # The programme's x_0 is s; the guess for the other states and controls is the prepared one.
        at = np.vstack([np.asarray(s, dtype=np.float64), x[1:], solution.predicted_states[-1:]])
        controls = u if a is None else np.vstack([a, u[1:]])
        weight = 0.0
        for count in range(self._iterations):
            weight = max(weight, 1.5 * float(np.abs(solution.costates).max()))
            length = self._step_length(at, controls, solution, weight) if count else 1.0
            at = at + length * (solution.predicted_states - at)
            controls = controls + length * (solution.predicted_actions - controls)
            before = self._costates.copy()
            self._x[:], self._u[:], self._costates[:] = at[:-1], controls, solution.costates[1:]
            self._linearise()
            solution = super()._solve(s, a)
            change = max(
                float(np.abs(solution.predicted_states - at).max()),
                float(np.abs(solution.predicted_actions - controls).max()),
                float(np.abs(solution.costates[1:] - self._costates).max())
                / (1 + float(np.abs(before).max())),
            )
            if change < self._tolerance:
                return self._read_out(s, a, solution)
        raise QpError(
            f"SQP did not converge in {self._iterations} iterations at s = {at[0]}; "
            f"last change {change:.1e}",
            status="not converged",
            qp=solution.qp.copy(),
        )

    def _step_length(
        self, at: Vector, controls: Vector, solution: RtiSolution, weight: float
    ) -> float:
        """Largest of 1, ½, ¼, … that gives the ℓ1 merit function a sufficient decrease."""
        step, turn = solution.predicted_states - at, solution.predicted_actions - controls
        cost, penalty, infeasibility, gradient = self._measure(at, controls)
        move = np.concatenate([step[1:].reshape(-1), turn.reshape(-1)])
        _, end, _, _ = self._measure(at + step, controls + turn)
        slope = float(gradient @ move) + end - penalty - weight * infeasibility
        start = cost + penalty + weight * infeasibility
        length = 1.0
        while length > 1e-6:
            trial = self._measure(at + length * step, controls + length * turn)
            merit_value = trial[0] + trial[1] + weight * trial[2]
            # Rounding of values near 1e6 must not stop the last, tiny steps.
            if merit_value <= start + 1e-4 * length * min(slope, 0.0) + 1e-12 * abs(start):
                return length
            length /= 2
        return length

    def _measure(self, at: Vector, controls: Vector) -> tuple[float, float, float, Vector]:
        function = self._merit
        function.inputs["s"][:], function.inputs["x"][:] = at[0], at[1:].reshape(-1)
        function.inputs["u"][:] = controls.reshape(-1)
        function.inputs["theta"][:] = self.theta
        function()
        cost, penalty, infeasibility = function.stack[-3:].tolist()
        return cost, penalty, infeasibility, function.part("gradient").copy()

    def _read_out(self, s: ArrayLike, a: ArrayLike | None, solution: RtiSolution) -> RtiSolution:
        """Read the solution out of the QP with the programme's own, unlifted Hessian."""
        self._known.solution = solution.multipliers
        if self._programme.parameters is not self.parameters:
            self._programme.parameters = self.parameters
        self._programme.prepare_at(
            LinearisationPoint(
                solution.predicted_states[:-1], solution.predicted_actions, solution.costates[1:]
            )
        )
        return self._programme.feedback(s, a)
