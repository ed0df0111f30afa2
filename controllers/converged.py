"""NMPC solved to convergence: SQP on the RTI's own QP."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from controllers.errors import QpError
from controllers.problem import Problem
from controllers.qp import NOT_CONVEX, QpBackend
from controllers.rti import RtiNmpc
from controllers.rti.nmpc import RtiSolution
from controllers.theta import Parameters
from cosim.core.protocols import Matrix


class ConvergedNmpc(RtiNmpc):
    """The NMPC of `RtiNmpc` with every programme solved to convergence; same θ, same read-outs.

    Q, V, π and their sensitivities are those of the nonlinear programme (paper.tex, Sensitivities
    of Fully Converged NMPC): at the solution the QP with the exact Hessian has the programme's KKT
    matrix. SQP on that QP converges quadratically; where it is not convex the Hessian is lifted.
    Every step is a full one.

    Args:
        problem: The control problem.
        parameters: θ.
        backend: As `RtiNmpc` takes it.
        tolerance: Largest change of states, actions and, relative to 1 + ‖χ‖∞, costates in a step,
            all in units of `Problem.scale`, below which the programme counts as solved.
        iterations: Most steps; where they do not reach the tolerance a feedback raises QpError.
    """

    name = "converged"
    memoryless = False
    """A feedback depends on earlier ones: it starts its SQP where the last one ended."""

    def __init__(
        self,
        problem: Problem,
        parameters: Parameters,
        *,
        backend: str | Callable[[], QpBackend] = "daqp",
        tolerance: float = 1e-10,
        iterations: int = 100,
    ) -> None:
        self._tolerance = tolerance
        # The steps of SQP, unlike those of `RtiNmpc`, all belong to one feedback.
        self._max_iterations = iterations
        super().__init__(problem, parameters, hessian="exact", backend=backend)

    def _linearise(self) -> None:
        """Prepare the QP of the exact Hessian, or of the lifted one if the backend refuses it."""
        try:
            self._linearise_as(lifts=False)
        except QpError as error:
            # Far from the solution the programme's own Hessian may be indefinite.
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
        for _ in range(self._max_iterations):
            # Full steps: the last QP's solution is the next point of linearisation.
            last = solution
            # The next linearisation writes over the costates of this one.
            last_costates = self._costates.copy()
            self._linearise_at(solution.unshifted)
            solution = self._solve_qp(s, a)
            change = self._change(solution, last, last_costates)
            if change < self._tolerance:
                if self._hessian.lifts:
                    return self._read_unlifted(a, solution)
                return solution
        raise QpError(
            f"SQP did not converge in {self._max_iterations} iterations at "
            f"s = {solution.predicted_states[0]}; the last change was {change:.1e} of the ranges",
            status="not converged",
            qp=solution.qp.copy(),
        )

    def _change(
        self,
        solution: RtiSolution,
        last: RtiSolution,
        last_costates: Matrix,
    ) -> float:
        """Largest change of a step's solution, without a unit; see the class."""
        scale = self.problem.scale
        d_states = solution.predicted_states - last.predicted_states
        d_actions = solution.predicted_actions - last.predicted_actions
        d_costates = solution.costates[1:] - self._costates
        # Costates may be large where the cost is: their change counts beside their size.
        size = 1 + _largest(last_costates / scale.state_price)
        return max(
            _largest(d_states / scale.state),
            _largest(d_actions / scale.action),
            _largest(d_costates / scale.state_price) / size,
        )

    def _read_unlifted(self, a: ArrayLike | None, solution: RtiSolution) -> RtiSolution:
        """Read a lifted QP's solution out of the programme's own QP, which need not be convex.

        At the solution of the programme both have the same primal-dual solution, but derivatives
        are those of the programme only with its own Hessian. A solver could not take that QP, and
        needs not: its solution is known.
        """
        enforced = a is not None
        action = None
        if a is not None:
            action = np.asarray(a, dtype=np.float64)
        try:
            self._hessian.lifts = False
            self._set_point(solution.unshifted)
            self._make_qp()
            self._embed_state(action)
            self._accept(solution.multipliers, enforced=enforced)
            prepared = self._keep_preparation(None)
            return self._solution(prepared, enforced=enforced)
        finally:
            # What stays prepared is the QP that a solver can take.
            self._linearise_as(lifts=True)


def _largest(values: Matrix) -> float:
    """Largest absolute value."""
    return float(np.abs(values).max())
