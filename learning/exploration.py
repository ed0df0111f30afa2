"""Exploration of the actions: additive, literal, by a perturbed cost; schedules; saturation.

A strategy maps (π(s), generator) to the action to apply, which the loop saturates to the actuators'
bounds. It returns the very array it was given where the sample stays greedy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from learning.errors import ConfigurationError

Vector = NDArray[np.float64]
PerturbedPolicy = Callable[[Vector], Vector]
"""Maps a linear cost term on the actions, (m,), to the policy's action under it, (m,)."""


@dataclass(frozen=True)
class Schedule:
    """A value that goes linearly from `start` to `end` over `samples`, then stays."""

    start: Vector
    end: Vector
    samples: int

    def __call__(self, sample: int) -> Vector:
        """Value at a sample, in the shape of `start`."""
        share = min(sample / self.samples, 1.0) if self.samples > 0 else 1.0
        return self.start + share * (self.end - self.start)


def schedule(start: ArrayLike, end: ArrayLike | None, samples: int) -> Schedule:
    """Linear schedule; without `end` it is constant."""
    first = np.asarray(start, dtype=np.float64)
    return Schedule(first, first if end is None else np.asarray(end, dtype=np.float64), samples)


class Strategy(Protocol):
    """An exploration strategy."""

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector:
        """Action to apply at a sample, (m,)."""

    def bias(self, action: Vector, sample: int) -> Vector:
        """E[a − π | explored], (m,): zero but for saturation; NaN where it is not known."""


@dataclass(frozen=True)
class Exploration:
    """What all strategies share: how often and how far, between which bounds."""

    lower: Vector
    upper: Vector
    probability: Schedule
    deviation: Schedule

    def noise(self, rng: np.random.Generator, sample: int) -> Vector | None:
        """Draw e ~ N(0, diag σ²), (m,), or None for a greedy sample."""
        # Drawn in every sample, so that paired runs stay in step whatever the probability.
        draw, e = rng.random(), rng.standard_normal(self.lower.size)
        if draw >= float(self.probability(sample)):
            return None
        scaled: Vector = self.deviation(sample) * e
        return scaled


@dataclass(frozen=True)
class Additive(Exploration):
    """a = sat(π(s) + e), e ~ N(0, diag σ²), on a share of the samples."""

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector:
        """Action to apply, (m,)."""
        e = self.noise(rng, sample)
        return action if e is None else action + e

    def bias(self, action: Vector, sample: int) -> Vector:
        """Mean of sat(π + e) − π, (m,), by the moments of the censored normal distribution."""
        sigma = np.maximum(self.deviation(sample), np.finfo(float).tiny)
        low, high = (self.lower - action) / sigma, (self.upper - action) / sigma
        density = (np.exp(-(low**2) / 2) - np.exp(-(high**2) / 2)) / np.sqrt(2 * np.pi)
        mean: Vector = sigma * (density + low * ndtr(low) + high * ndtr(-high))
        return mean


@dataclass(frozen=True)
class Literal(Exploration):
    """a = sat(e), as the paper prints it: the policy's action is replaced, not perturbed."""

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector:
        """Action to apply, (m,)."""
        e = self.noise(rng, sample)
        return action if e is None else e

    def bias(self, action: Vector, sample: int) -> Vector:
        """Mean of sat(e) − π, (m,)."""
        origin = np.zeros_like(action)
        return Additive.bias(self, origin, sample) - action  # type: ignore[arg-type]


@dataclass(frozen=True)
class PerturbedCost(Exploration):
    """The policy of a cost with a random linear term dᵀu in each stage, d ~ N(0, diag σ²).

    The perturbed policy obeys every constraint that the policy obeys, so nothing saturates; σ is
    in units of cost per unit of action.
    """

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector:
        """Action to apply, (m,)."""
        d = self.noise(rng, sample)
        return action if d is None else perturbed(d)

    def bias(self, action: Vector, sample: int) -> Vector:
        """Not known in closed form: NaN, (m,)."""
        return np.full_like(action, np.nan)


STRATEGIES: dict[str, type[Additive | Literal | PerturbedCost]] = {
    "additive": Additive,
    "literal": Literal,
    "perturbed-cost": PerturbedCost,
}


def strategy(
    kind: str, lower: Vector, upper: Vector, probability: Schedule, deviation: Schedule
) -> Strategy:
    """Strategy by name; raises ConfigurationError on a wrong name or number of deviations."""
    if kind not in STRATEGIES:
        raise ConfigurationError(
            f"there is no exploration '{kind}'; there are {', '.join(STRATEGIES)}"
        )
    for values in (deviation.start, deviation.end):
        if values.size not in (1, lower.size):
            raise ConfigurationError(
                f"exploration_deviation has {values.size} entries; give one, or one for each of "
                f"the {lower.size} actions"
            )
    return STRATEGIES[kind](lower, upper, probability, deviation)
