"""Learning of an NMPC's θ from plant data: the rules, and all that an own one needs."""

from typing import TYPE_CHECKING

import lazy_loader

from learning.actor_critic import ActorCritic
from learning.algorithm import Algorithm, Strategy, Transition, Update, algorithms
from learning.batch_q_learning import BatchQLearning
from learning.checkpoint import arrays_of, take_up
from learning.configuration import Configuration
from learning.errors import (
    AlgorithmLookupError,
    CheckpointError,
    ConfigurationError,
    DivergenceError,
    LearningError,
    PrivilegeError,
)  # fmt: skip
from learning.q_learning import QLearning
from learning.search import Search
from learning.step import ConstrainedStep, td_step

if TYPE_CHECKING:
    from learning.training import Tracker, Training, TrainingRun, train

__all__ = [
    "ActorCritic", "Algorithm", "AlgorithmLookupError", "BatchQLearning", "CheckpointError",
    "Configuration", "ConfigurationError", "ConstrainedStep", "DivergenceError", "LearningError",
    "PrivilegeError", "QLearning", "Search", "Strategy", "Tracker", "Training", "TrainingRun",
    "Transition", "Update", "algorithms", "arrays_of", "take_up", "td_step", "train",
]  # fmt: skip

# Imported on first use: half a second that a rule does not need.
__getattr__, _, _ = lazy_loader.attach(
    __name__, submod_attrs={"training": ["Tracker", "Training", "TrainingRun", "train"]}
)
