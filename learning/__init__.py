"""Learning of an NMPC's θ from plant data: the rules, and all that a rule of one's own needs."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from learning.actor_critic import ActorCritic
from learning.algorithm import Algorithm, Transition, Update, algorithms
from learning.batch_q_learning import BatchQLearning
from learning.checkpoint import part_of, prefixed
from learning.configuration import Configuration
from learning.errors import (
    AlgorithmLookupError,
    CheckpointError,
    ConfigurationError,
    DivergenceError,
    LearningError,
    PrivilegeError,
)
from learning.exploration import Strategy
from learning.q_learning import QLearning
from learning.step import ConstrainedStep, td_step

if TYPE_CHECKING:
    from learning.training import Tracker, Training, train
    from learning.training_run import TrainingRun

__all__ = [
    "ActorCritic", "Algorithm", "AlgorithmLookupError", "BatchQLearning", "CheckpointError",
    "Configuration", "ConfigurationError", "ConstrainedStep", "DivergenceError", "LearningError",
    "PrivilegeError", "QLearning", "Strategy", "Tracker", "Training", "TrainingRun", "Transition",
    "Update", "algorithms", "part_of", "prefixed", "td_step", "train",
]  # fmt: skip
# On first use: half a second of imports that a rule does not need.
LAZY = {
    "Tracker": "learning.training",
    "Training": "learning.training",
    "TrainingRun": "learning.training_run",
    "train": "learning.training",
}


def __getattr__(name: str) -> Any:
    if name not in LAZY:
        raise AttributeError(f"module 'learning' has no attribute '{name}'")
    return getattr(import_module(LAZY[name]), name)
