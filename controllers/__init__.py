"""NMPC as function approximator: parametric OCP, one QP per sample, its sensitivities."""

from controllers.converged import ConvergedNmpc
from controllers.errors import ControllerError, QpError
from controllers.layout import Layout
from controllers.model import Model, Quantity
from controllers.optimum import OptimalPolicy
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.solution import LinearisationPoint, RtiSolution

__all__ = [
    "ControllerError",
    "ConvergedNmpc",
    "Layout",
    "LinearisationPoint",
    "Model",
    "OptimalPolicy",
    "Parameters",
    "Problem",
    "QpError",
    "Quantity",
    "RtiNmpc",
    "RtiSolution",
]
