"""NMPC as function approximator: parametric OCP, one QP per sample, its sensitivities."""

from typing import TYPE_CHECKING

import lazy_loader

from controllers.converged import ConvergedNmpc
from controllers.errors import ControllerError, QpError
from controllers.model import Model, Quantity
from controllers.problem import Problem
from controllers.rti import RtiNmpc, compile_functions
from controllers.rti.nmpc import LinearisationPoint, RtiSolution
from controllers.theta import Parameters, ThetaBlocks

if TYPE_CHECKING:
    from controllers.estimator import ExtendedKalmanFilter, OutputFeedback
    from controllers.optimum import OptimalPolicy
    from controllers.plant import build_plant

__all__ = [
    "ControllerError",
    "ConvergedNmpc",
    "ExtendedKalmanFilter",
    "LinearisationPoint",
    "Model",
    "OptimalPolicy",
    "OutputFeedback",
    "Parameters",
    "Problem",
    "QpError",
    "Quantity",
    "RtiNmpc",
    "RtiSolution",
    "ThetaBlocks",
    "build_plant",
    "compile_functions",
]

# Imported on first use: a controller must not pay for the import of SciPy.
__getattr__, _, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "estimator": ["ExtendedKalmanFilter", "OutputFeedback"],
        "optimum": ["OptimalPolicy"],
        "plant": ["build_plant"],
    },
)
