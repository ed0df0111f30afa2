"""Exploration of the actions, and what saturation does to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.errors import ConfigurationError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
KINDS = ("additive", "literal")


@dataclass(frozen=True)
class Strategy:
    """Draws the actions that explore: a = sat(c + e), e ~ N(0, diag σ²), on a share of the samples.

    The centre c is the policy's action (`additive`) or zero (`literal`, as the paper prints it).
    `probability` is the share and `deviation` σ (m,) or (1,) in the actions' units; `lower` and
    `upper` (m,) bound the action. The loop saturates.
    """

    kind: str
    lower: Vector
    upper: Vector
    probability: float
    deviation: Vector

    def __call__(self, action: Vector, rng: np.random.Generator) -> Vector | None:
        """Action that explores where the policy's is `action`, (m,), or None: stay greedy."""
        # Drawn in every sample, so that paired runs stay in step whatever the probability.
        draw, e = rng.random(), rng.standard_normal(self.lower.size)
        if draw >= self.probability:
            return None
        explored: Vector = self._centre(action) + self.deviation * e
        return explored

    def bias(self, actions: Matrix) -> Matrix:
        """E[a − π | explored] of samples with policies π, (K, m).

        From the moments of the censored normal distribution; zero but for saturation and a centre
        that is not π.
        """
        centres = self._centre(actions)
        sigma = np.maximum(self.deviation, np.finfo(float).tiny)
        low, high = (self.lower - centres) / sigma, (self.upper - centres) / sigma
        density = (np.exp(-(low**2) / 2) - np.exp(-(high**2) / 2)) / np.sqrt(2 * np.pi)
        mean: Matrix = sigma * (density + low * ndtr(low) + high * ndtr(-high))
        return mean + (centres - actions)

    def _centre(self, action: Vector) -> Vector:
        return action if self.kind == "additive" else np.zeros_like(action)


def build_strategy(configuration: Configuration, scenario: Scenario) -> Strategy:
    """Exploration as a configuration says.

    Raises ConfigurationError on an unknown kind or a wrong number of deviations.
    """
    kind, probability = configuration.exploration, configuration.exploration_probability
    if kind == "none":
        kind, probability = "additive", 0.0
    if kind not in KINDS:
        raise ConfigurationError(f"there is no exploration '{kind}'; there are {', '.join(KINDS)}")
    lower, upper = scenario.action_lower, scenario.action_upper
    deviation = np.asarray(configuration.deviation(scenario), dtype=np.float64)
    if deviation.size not in (1, lower.size):
        raise ConfigurationError(
            f"exploration_deviation has {deviation.size} entries; give one, or one for each of "
            f"the {lower.size} actions"
        )
    return Strategy(kind, lower, upper, probability, deviation)
