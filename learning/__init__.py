"""Reinforcement learning rules that tune an NMPC from plant data."""

from learning.actor_critic import ActorCritic
from learning.batch_q_learning import BatchQLearning
from learning.q_learning import QLearning

__all__ = ["ActorCritic", "BatchQLearning", "QLearning"]
