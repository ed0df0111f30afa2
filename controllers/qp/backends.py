"""The protocol of a QP backend and the names under which backends are chosen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from controllers.errors import ControllerError
from controllers.qp.daqp_backend import DaqpBackend
from controllers.qp.problem import QpSolution, SoftQp
from controllers.qp.proxqp_backend import ProxQpBackend
from controllers.qp.qpsolvers_backend import QpsolversBackend


class QpBackend(Protocol):
    """A solver of `SoftQp`s of one size with finite data; condensed or not is its own affair."""

    def load(self, qp: SoftQp) -> None:
        """Take over the matrices H, rows and weights (the preparation phase)."""

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp` and the matrices last loaded (the feedback phase).

        Raises QpError, which carries a copy of the QP, where it is not solved.
        """


BACKENDS: dict[str, Callable[[], QpBackend]] = {"daqp": DaqpBackend, "proxqp": ProxQpBackend}


def make_backend(name: str) -> QpBackend:
    """Backend by name: `daqp`, `proxqp`, or `qpsolvers:SOLVER` for any that qpsolvers has.

    Raises ControllerError on an unknown name.
    """
    if name.startswith("qpsolvers:"):
        return QpsolversBackend(name.removeprefix("qpsolvers:"))
    if name not in BACKENDS:
        raise ControllerError(
            f"there is no QP backend '{name}'; choose {', '.join(BACKENDS)} or qpsolvers:SOLVER"
        )
    return BACKENDS[name]()
