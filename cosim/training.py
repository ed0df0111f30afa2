"""What `cosim.train` and `cosim.Training` are: handed on from the packages above."""

from controllers.theta import Parameters
from learning.training import Training, train

__all__ = ["Parameters", "Training", "train"]
