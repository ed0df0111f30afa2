"""NMPC as function approximator: parametric OCP, one QP per sample, its sensitivities."""

from controllers.errors import ControllerError, QpError
from controllers.layout import Layout
from controllers.model import Model, Quantity
from controllers.parameters import Parameters
from controllers.problem import Problem

__all__ = ["ControllerError", "Layout", "Model", "Parameters", "Problem", "QpError", "Quantity"]
