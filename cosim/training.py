"""What `cosim.train` and `cosim.Training` are: handed on from `learning`."""

from learning.training import Training, train

__all__ = ["Training", "train"]
