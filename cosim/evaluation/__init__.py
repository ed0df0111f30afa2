"""Paired Monte Carlo: controllers × seeds on common random numbers, on one machine or many."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim.evaluation.paired import evaluate as evaluate
    from cosim.evaluation.table import Evaluation as Evaluation

# Imported on first use: a worker needs a unit's code, not tables and statistics.
_HOMES = {"Evaluation": "cosim.evaluation.table", "evaluate": "cosim.evaluation.paired"}

__all__ = ["Evaluation", "evaluate"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cosim.evaluation' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
