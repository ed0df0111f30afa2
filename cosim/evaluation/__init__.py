"""Paired Monte Carlo: controllers × seeds on common random numbers, on one machine or many."""

from typing import TYPE_CHECKING

from cosim.lazy import on_first_use

if TYPE_CHECKING:
    from cosim.evaluation.paired import evaluate as evaluate
    from cosim.evaluation.table import Evaluation as Evaluation

# Imported on first use: a worker needs a unit's code, not tables and statistics.
__getattr__, __dir__ = on_first_use(
    __name__,
    {"Evaluation": "cosim.evaluation.table", "evaluate": "cosim.evaluation.paired"},
)

__all__ = ["Evaluation", "evaluate"]
