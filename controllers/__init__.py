"""NMPC as function approximator: parametric OCP, one QP per sample, its sensitivities."""

from controllers.converged import ConvergedNmpc
from controllers.errors import ControllerError, QpError
from controllers.model import Model, Quantity
from controllers.optimum import OptimalPolicy
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.rti.solution import LinearisationPoint, RtiSolution
from controllers.theta import ThetaBlocks

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
]
