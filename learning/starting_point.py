"""Moved to `learning.training_run` and `learning.exploration`."""

from learning.exploration import build_strategy
from learning.training_run import build_controller, starting_parameters

__all__ = ["build_controller", "build_strategy", "starting_parameters"]
