"""Moved to `learning.algorithm`."""

from learning.algorithm import GROUP, algorithms, load_algorithm

__all__ = ["GROUP", "algorithms", "load_algorithm"]
