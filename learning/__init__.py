"""Reinforcement learning rules that tune an NMPC from plant data."""

from typing import TYPE_CHECKING

from cosim.lazy import on_first_use
from learning.actor_critic import ActorCritic
from learning.batch_q_learning import BatchQLearning
from learning.q_learning import QLearning

if TYPE_CHECKING:
    from learning.training import Training as Training
    from learning.training import train as train

# Imported on first use: a rule alone needs neither plant nor statistics.
__getattr__, __dir__ = on_first_use(
    __name__,
    {"Training": "learning.training", "train": "learning.training"},
)

__all__ = ["ActorCritic", "BatchQLearning", "QLearning", "Training", "train"]
