"""Real-time-iteration NMPC: preparation, feedback, and the solution of one sample's QP."""

from controllers.rti.nmpc import RtiNmpc, compile_functions
from controllers.rti.solution import LinearisationPoint, RtiSolution

__all__ = ["LinearisationPoint", "RtiNmpc", "RtiSolution", "compile_functions"]
