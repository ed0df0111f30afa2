"""A small number of QPs a sample: RTI that goes on towards convergence (paper.tex, RTI NMPC)."""

from __future__ import annotations

from collections.abc import Callable

from numpy.typing import ArrayLike

from controllers.errors import ControllerError
from controllers.problem import Problem
from controllers.qp import QpBackend
from controllers.rti.nmpc import RtiNmpc
from controllers.rti.solution import RtiSolution
from controllers.theta import Parameters


class IteratedNmpc(RtiNmpc):
    """`RtiNmpc` with `iterations` QPs a feedback, each linearised at the solution of the last.

    Full steps without a line search, at the state that was measured: with one QP it is the RTI,
    with many the limit is `ConvergedNmpc`. Value, policy and derivatives are those of the last QP
    at its own point of linearisation. What `prepare` prepared stays for the sample's other
    feedbacks, so that Q(s, π(s)) = V(s), and for replay. Raises ControllerError on `iterations`
    below 1.
    """

    def __init__(
        self,
        problem: Problem,
        parameters: Parameters,
        *,
        iterations: int,
        hessian: str = "gauss-newton",
        backend: str | Callable[[], QpBackend] = "daqp",
    ) -> None:
        """Build as `RtiNmpc`; see the class."""
        if iterations < 1:
            raise ControllerError(f"iterations must be at least 1, not {iterations}")
        self._qps = iterations
        super().__init__(problem, parameters, hessian=hessian, backend=backend)

    def _solve(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        solution = super()._solve(s, a)
        prepared = self.linearisation_point
        try:
            for _ in range(self._qps - 1):
                self._linearise_at(solution.unshifted)
                solution = super()._solve(s, a)
        finally:
            if self._qps > 1:
                self._linearise_at(prepared)
        return solution
