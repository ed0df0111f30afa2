"""Reinforcement learning rules that tune an NMPC from plant data."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from learning.actor_critic import ActorCritic
from learning.batch_q_learning import BatchQLearning
from learning.q_learning import QLearning

if TYPE_CHECKING:
    from learning.training import Training as Training
    from learning.training import train as train

# Imported on first use: a worker that trains has no use for what draws.
_HOMES = {"Training": "learning.training", "train": "learning.training"}

__all__ = ["ActorCritic", "BatchQLearning", "QLearning", "Training", "train"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'learning' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
