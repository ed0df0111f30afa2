"""Learning of an NMPC's θ from plant data: the rules, and all that an own one needs."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from learning.actor_critic import ActorCritic as ActorCritic
    from learning.algorithm import Algorithm as Algorithm
    from learning.algorithm import Strategy as Strategy
    from learning.algorithm import Transition as Transition
    from learning.algorithm import Update as Update
    from learning.algorithm import algorithms as algorithms
    from learning.batch_q_learning import BatchQLearning as BatchQLearning
    from learning.checkpoint import arrays_of as arrays_of
    from learning.checkpoint import take_up as take_up
    from learning.configuration import Configuration as Configuration
    from learning.errors import AlgorithmLookupError as AlgorithmLookupError
    from learning.errors import CheckpointError as CheckpointError
    from learning.errors import ConfigurationError as ConfigurationError
    from learning.errors import DivergenceError as DivergenceError
    from learning.errors import LearningError as LearningError
    from learning.errors import PrivilegeError as PrivilegeError
    from learning.q_learning import QLearning as QLearning
    from learning.search import Search as Search
    from learning.step import ConstrainedStep as ConstrainedStep
    from learning.step import td_step as td_step
    from learning.training import Tracker as Tracker
    from learning.training import Training as Training
    from learning.training import TrainingRun as TrainingRun
    from learning.training import train as train

# Imported on first use: a command that trains nothing must not pay for SciPy.
_HOMES = {
    "actor_critic": "ActorCritic",
    "algorithm": "Algorithm Strategy Transition Update algorithms",
    "batch_q_learning": "BatchQLearning",
    "checkpoint": "arrays_of take_up",
    "configuration": "Configuration",
    "errors": "AlgorithmLookupError CheckpointError ConfigurationError DivergenceError "
    "LearningError PrivilegeError",
    "q_learning": "QLearning",
    "search": "Search",
    "step": "ConstrainedStep td_step",
    "training": "Tracker Training TrainingRun train",
}
_HOME = {name: module for module, names in _HOMES.items() for name in names.split()}
__all__ = sorted(_HOME)  # noqa: PLE0605 - a list all the same


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'learning' has no attribute '{name}'")
    return getattr(import_module(f"learning.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
