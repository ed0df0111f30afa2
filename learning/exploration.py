"""Exploration of the actions, what saturation does to it, and schedules over a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.errors import ConfigurationError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Samples = NDArray[np.int64]
KINDS = ("additive", "literal")


@dataclass(frozen=True)
class Linear:
    """A value that goes linearly from `start` to `end` over `samples`, then stays."""

    start: Vector
    end: Vector
    samples: int

    def __call__(self, sample: int) -> Vector:
        """Value at a sample, in the shape of `start`."""
        if self.end is self.start:
            return self.start
        share = min(sample / self.samples, 1.0) if self.samples > 0 else 1.0
        return self.start + share * (self.end - self.start)

    def at(self, samples: Samples) -> NDArray[np.float64]:
        """Values at samples, (K,), in the shape (K, …) with that of `start` behind."""
        done = samples / self.samples if self.samples > 0 else np.ones(len(samples))
        shares = np.minimum(done, 1.0).reshape(-1, *(1,) * self.start.ndim)
        values: NDArray[np.float64] = self.start + shares * (self.end - self.start)
        return values


@dataclass(frozen=True)
class Geometric:
    """A positive number that goes from `start` to `end` by equal ratios over `samples`."""

    start: float
    end: float
    samples: int

    def __call__(self, sample: int) -> float:
        """Value at a sample."""
        value: float = self.start * (self.end / self.start) ** min(sample / self.samples, 1.0)
        return value


def linear(start: ArrayLike, end: ArrayLike | None, samples: int) -> Linear:
    """Linear schedule; without `end` it is constant."""
    first = np.asarray(start, dtype=np.float64)
    return Linear(first, first if end is None else np.asarray(end, dtype=np.float64), samples)


@dataclass(frozen=True)
class Strategy:
    """Draws the actions that explore: a = sat(c + e), e ~ N(0, diag σ²), on a share of the samples.

    The centre c is the policy's action (`additive`) or zero (`literal`, as the paper prints it).
    `probability` is the share and `deviation` σ (m,) in the actions' units, each linear in the
    sample; `lower` and `upper` (m,) bound the action. The loop saturates.
    """

    kind: str
    lower: Vector
    upper: Vector
    probability: Linear
    deviation: Linear

    def __call__(self, action: Vector, rng: np.random.Generator, sample: int) -> Vector | None:
        """Action that explores where the policy's is `action`, (m,), or None: stay greedy."""
        # Drawn in every sample, so that paired runs stay in step whatever the probability.
        draw, e = rng.random(), rng.standard_normal(self.lower.size)
        if draw >= float(self.probability(sample)):
            return None
        explored: Vector = self._centre(action) + self.deviation(sample) * e
        return explored

    def bias(self, actions: Matrix, samples: Samples) -> Matrix:
        """E[a − π | explored] of samples with policies π, (K, m).

        From the moments of the censored normal distribution; zero but for saturation and a centre
        that is not π.
        """
        centres = self._centre(actions)
        sigma = np.maximum(self.deviation.at(samples), np.finfo(float).tiny)
        low, high = (self.lower - centres) / sigma, (self.upper - centres) / sigma
        density = (np.exp(-(low**2) / 2) - np.exp(-(high**2) / 2)) / np.sqrt(2 * np.pi)
        mean: Matrix = sigma * (density + low * ndtr(low) + high * ndtr(-high))
        return mean + (centres - actions)

    def _centre(self, action: Vector) -> Vector:
        return action if self.kind == "additive" else np.zeros_like(action)


def build_strategy(configuration: Configuration, scenario: Scenario, samples: int) -> Strategy:
    """Exploration of a run of `samples` samples, its schedules spread over them.

    Raises ConfigurationError on an unknown kind or a wrong number of deviations.
    """
    kind, probability = configuration.exploration, configuration.exploration_probability
    probability_end = configuration.exploration_probability_end
    if kind == "none":
        kind, probability, probability_end = "additive", 0.0, None
    if kind not in KINDS:
        raise ConfigurationError(f"there is no exploration '{kind}'; there are {', '.join(KINDS)}")
    lower, upper = scenario.action_lower, scenario.action_upper
    end = configuration.exploration_deviation_end
    deviation = linear(configuration.deviation(scenario), end, samples)
    for values in (deviation.start, deviation.end):
        if values.size not in (1, lower.size):
            raise ConfigurationError(
                f"exploration_deviation has {values.size} entries; give one, or one for each of "
                f"the {lower.size} actions"
            )
    shares = linear(probability, probability_end, samples)
    return Strategy(kind, lower, upper, shares, deviation)
