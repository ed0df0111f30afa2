"""Errors of the controllers; each message names the mistake and the remedy."""

from __future__ import annotations

from typing import Any, ClassVar

from cosim.core.errors import CosimError, CosimWarning


class ControllerError(CosimError):
    """Base of all errors that the package raises."""


class ModelError(ControllerError):
    """The control model or the control problem is malformed."""


class ModelWarning(CosimWarning):
    """The control model can be used, but not as fast or as accurately as its user may think."""


class ParameterError(ControllerError):
    """A parameter vector, block or file is malformed."""


class TuningWarning(CosimWarning):
    """The economic cost cannot be tuned as it is: a quadratic is added to it."""


class OptimumError(ControllerError):
    """The dynamic-programming policy cannot be computed, stored or read."""


class TuningError(ControllerError):
    """The economic tuning has no solution."""


class QpError(ControllerError):
    """A QP was not solved; it carries the problem for diagnosis.

    `qp` is a copy of the `SoftQp` that failed, None for a controller that solves none; `status` is
    the backend's own word for the failure. A closed loop recognises the class by
    `is_solver_failure`, applies its fallback action and counts the failure.
    """

    is_solver_failure: ClassVar[bool] = True

    def __init__(
        self,
        message: str,
        *,
        status: str,
        qp: Any = None,
    ) -> None:
        super().__init__(message)
        self.status = status
        self.qp = qp
