"""Learning of an NMPC's θ from plant data: the rules, and all that an own one needs."""

from typing import TYPE_CHECKING

from cosim.lazy import on_first_use
from learning.actor_critic import ActorCritic
from learning.algorithm import Algorithm, LearnableController, Transition, Update, algorithms
from learning.batch_q_learning import BatchQLearning
from learning.checkpoint import arrays_of, take_up
from learning.configuration import Configuration
from learning.constrained_step import ConstrainedStep
from learning.errors import (
    AlgorithmLookupError,
    CheckpointError,
    ConfigurationError,
    DefinitenessError,
    DivergenceError,
    LearningError,
    PrivilegeError,
)
from learning.exploration import Strategy
from learning.q_learning import QLearning

if TYPE_CHECKING:
    from learning.training import Training as Training
    from learning.training import train as train

# Imported on first use: a rule alone needs neither plant nor statistics.
__getattr__, __dir__ = on_first_use(
    __name__,
    {"Training": "learning.training", "train": "learning.training"},
)

__all__ = [
    "ActorCritic",
    "Algorithm",
    "AlgorithmLookupError",
    "BatchQLearning",
    "CheckpointError",
    "Configuration",
    "ConfigurationError",
    "ConstrainedStep",
    "DefinitenessError",
    "DivergenceError",
    "LearnableController",
    "LearningError",
    "PrivilegeError",
    "QLearning",
    "Strategy",
    "Training",
    "Transition",
    "Update",
    "algorithms",
    "arrays_of",
    "take_up",
    "train",
]
