"""Exploration: which samples apply another action than the policy's, and which one."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from cosim.core.protocols import Matrix, Vector
from cosim.core.scenario import Scenario
from learning.configuration import Configuration
from learning.errors import ConfigurationError


class Strategy:
    """Draws the actions that explore: a = sat(c + e), e ~ N(0, diag σ²), on a share of the samples.

    After the first T samples the k-th explores with the share's probability times T/k. So the cost
    of exploration goes to zero, while each action is still tried without end (the condition GLIE of
    Singh, Jaakkola, Littman and Szepesvári, Machine Learning 38, 2000). The centre c is the
    policy's action (`additive`) or zero (`literal`, as the paper prints it).

    Attributes:
        probability: share of the samples that explore, before it falls.
        deviation: σ, (m,) or (1,), in the actions' units.
        lower, upper: bounds (m,) at which the loop saturates.

    Raises:
        ConfigurationError: a wrong number of deviations.
    """

    def __init__(self, configuration: Configuration, scenario: Scenario) -> None:
        self.kind = configuration.exploration
        self.lower = scenario.action_lower
        self.upper = scenario.action_upper
        span = self.upper - self.lower
        self.deviation: Vector = configuration.exploration_share * span
        if configuration.exploration_deviation is not None:
            self.deviation = np.array(configuration.exploration_deviation)
        n_actions = self.lower.size
        if self.deviation.size not in (1, n_actions):
            raise ConfigurationError(
                f"exploration_deviation has {self.deviation.size} entries; give one, or one for "
                f"each of the {n_actions} actions"
            )
        self.probability = configuration.exploration_probability
        self._full_samples = configuration.full_exploration
        if self.kind == "none":
            self.probability = 0.0

    def __call__(
        self,
        action: Vector,
        rng: np.random.Generator,
        number: int = 0,
    ) -> Vector | None:
        """The action that explores, if one does.

        Args:
            action: the policy's, (m,).
            rng: draws in every sample.
            number: of the sample, from 0.

        Returns:
            The exploring action, (m,), or None: greedy.
        """
        # Draw in every sample, so that runs of any probability stay paired.
        draw = rng.random()
        e = rng.standard_normal(self.lower.size)
        # Where nothing falls the number of full samples is infinite.
        decay = min(1.0, self._full_samples / (number + 1))
        if draw >= self.probability * decay:
            return None
        centre = self._centre(action)
        exploring: Vector = centre + self.deviation * e
        return exploring

    def bias(self, actions: Matrix) -> Matrix:
        """E[a − π | explored] of samples with policies π, (K, m).

        The mean of the censored normal distribution less π; zero without saturation if the centre
        is π.
        """
        centres = self._centre(actions)
        # Without a deviation the censored normal is a point: a tiny one gives its limit.
        tiny = np.finfo(float).tiny
        sigma = np.maximum(self.deviation, tiny)
        to_lower = self.lower - centres
        to_upper = self.upper - centres
        low = to_lower / sigma
        high = to_upper / sigma
        # Mean of min(max(c + e, lower), upper): the density at the bounds, and their tails.
        density_low = np.exp(-(low**2) / 2)
        density_high = np.exp(-(high**2) / 2)
        difference = density_low - density_high
        density = difference / np.sqrt(2 * np.pi)
        tail_low = low * ndtr(low)
        tail_high = high * ndtr(-high)
        mean: Matrix = sigma * (density + tail_low + tail_high)
        return mean + (centres - actions)

    def _centre(self, action: Vector) -> Vector:
        """Centre of the noise: c."""
        if self.kind == "literal":
            return np.zeros_like(action)
        return action
