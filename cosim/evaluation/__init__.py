"""Paired Monte Carlo: controllers × seeds on common random numbers, on one machine or many."""

from cosim.evaluation.paired import evaluate
from cosim.evaluation.table import Evaluation

__all__ = ["Evaluation", "evaluate"]
