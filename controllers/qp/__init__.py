"""The QP of one sample, what its solution is worth, and the backends that solve it."""

from controllers.qp.backends import BACKENDS, QpBackend, make_backend
from controllers.qp.problem import QpSolution, Residuals, SoftQp, Stages

__all__ = [
    "BACKENDS",
    "QpBackend",
    "QpSolution",
    "Residuals",
    "SoftQp",
    "Stages",
    "make_backend",
]
