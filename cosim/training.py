"""`cosim.train` and `cosim.Training`, imported from the package `learning`."""

from learning.training import Training, train

__all__ = ["Training", "train"]
