"""The QP of one sample, what its solution is worth, and the backends that solve it."""

from __future__ import annotations

from typing import Protocol

from controllers.errors import ControllerError
from controllers.qp.problem import QpSolution, Residuals, SoftQp

__all__ = ["QpBackend", "QpSolution", "Residuals", "SoftQp", "make_backend"]


class QpBackend(Protocol):
    """A solver of `SoftQp`s of one size with finite data."""

    def load(self, qp: SoftQp) -> None:
        """Take over the matrices H, rows and weights (the preparation phase)."""

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp` and the matrices last loaded (the feedback phase).

        Raises QpError, which carries a copy of the QP, where it is not solved.
        """


def make_backend(name: str) -> QpBackend:
    """Backend by name: `daqp`, `proxqp`, or `qpsolvers:SOLVER` for any that qpsolvers has.

    Raises ControllerError on an unknown name.
    """
    kind, _, solver = name.partition(":")
    # Imported when chosen: a solver is slow to import.
    if name == "daqp":
        from controllers.qp.daqp_backend import DaqpBackend  # noqa: PLC0415

        return DaqpBackend()
    if name == "proxqp":
        from controllers.qp.explicit_slack import ProxQpBackend  # noqa: PLC0415

        return ProxQpBackend()
    if kind == "qpsolvers" and solver:
        from controllers.qp.explicit_slack import QpsolversBackend  # noqa: PLC0415

        return QpsolversBackend(solver)
    raise ControllerError(
        f"there is no QP backend '{name}'; choose daqp, proxqp or qpsolvers:SOLVER"
    )
