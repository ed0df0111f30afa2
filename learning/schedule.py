"""Moved to `learning.exploration`."""

from learning.exploration import Geometric, Linear, linear

__all__ = ["Geometric", "Linear", "linear"]
