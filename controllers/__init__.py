"""NMPC as function approximator: parametric OCP, one QP per sample, its sensitivities."""

from typing import TYPE_CHECKING, Any

from controllers.converged import ConvergedNmpc
from controllers.errors import ControllerError, QpError
from controllers.model import Model, Quantity
from controllers.problem import Problem
from controllers.rti import RtiNmpc, compile_functions
from controllers.rti.nmpc import LinearisationPoint, RtiSolution
from controllers.theta import Parameters, ThetaBlocks

if TYPE_CHECKING:
    from controllers.optimum import OptimalPolicy

__all__ = [
    "ControllerError",
    "ConvergedNmpc",
    "LinearisationPoint",
    "Model",
    "OptimalPolicy",
    "Parameters",
    "Problem",
    "QpError",
    "Quantity",
    "RtiNmpc",
    "RtiSolution",
    "ThetaBlocks",
    "compile_functions",
]


def __getattr__(name: str) -> Any:
    if name != "OptimalPolicy":
        raise AttributeError(f"module 'controllers' has no attribute '{name}'")
    # On first use: a controller must not pay for the import of SciPy.
    from controllers.optimum import OptimalPolicy  # noqa: PLC0415

    return OptimalPolicy
