"""Real-time-iteration NMPC: preparation, feedback, and the solution of one sample's QP."""

from controllers.rti.nmpc import LinearisationPoint, RtiNmpc, RtiSolution, compile_functions

__all__ = ["LinearisationPoint", "RtiNmpc", "RtiSolution", "compile_functions"]
