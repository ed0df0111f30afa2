"""Learning of an NMPC's θ from plant data: the rules, and all that a rule of one's own needs."""

from typing import TYPE_CHECKING

import lazy_loader

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
    from learning.from_data import train_from_data
    from learning.log_answer import TrainingFromData
    from learning.training import Tracker, Training, train
    from learning.training_run import TrainingRun

__all__ = [
    "ActorCritic", "Algorithm", "AlgorithmLookupError", "BatchQLearning", "CheckpointError",
    "Configuration", "ConfigurationError", "ConstrainedStep", "DivergenceError", "LearningError",
    "PrivilegeError", "QLearning", "Strategy", "Tracker", "Training", "TrainingFromData",
    "TrainingRun", "Transition", "Update", "algorithms", "part_of", "prefixed", "td_step", "train",
    "train_from_data",
]  # fmt: skip

# Imported on first use: half a second that a rule does not need.
__getattr__, _, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "from_data": ["train_from_data"],
        "log_answer": ["TrainingFromData"],
        "training": ["Tracker", "Training", "train"],
        "training_run": ["TrainingRun"],
    },
)
