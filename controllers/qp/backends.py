"""The protocol of a QP backend and the names under which backends are chosen."""

from __future__ import annotations

from importlib import import_module
from typing import Protocol

from controllers.errors import ControllerError
from controllers.qp.problem import QpSolution, SoftQp


class QpBackend(Protocol):
    """A solver of `SoftQp`s of one size with finite data; condensed or not is its own affair."""

    def load(self, qp: SoftQp) -> None:
        """Take over the matrices H, rows and weights (the preparation phase)."""

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp` and the matrices last loaded (the feedback phase).

        Raises QpError, which carries a copy of the QP, where it is not solved.
        """


BACKENDS = {
    "daqp": "controllers.qp.daqp_backend:DaqpBackend",
    "proxqp": "controllers.qp.proxqp_backend:ProxQpBackend",
    "qpsolvers": "controllers.qp.qpsolvers_backend:QpsolversBackend",
}
"""Class of each backend by name, imported when it is chosen: a solver is slow to import."""


def make_backend(name: str) -> QpBackend:
    """Backend by name: `daqp`, `proxqp`, or `qpsolvers:SOLVER` for any that qpsolvers has.

    Raises ControllerError on an unknown name.
    """
    kind, _, solver = name.partition(":")
    if kind not in BACKENDS or (kind == "qpsolvers") != bool(solver):
        raise ControllerError(
            f"there is no QP backend '{name}'; choose daqp, proxqp or qpsolvers:SOLVER"
        )
    module, _, attribute = BACKENDS[kind].partition(":")
    backend: QpBackend = getattr(import_module(module), attribute)(*([solver] if solver else []))
    return backend
