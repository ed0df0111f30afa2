"""Exploration of the actions: additive, literal, by a perturbed cost; and what saturation does.

A strategy maps (π(s), generator) to the action to apply, which the loop saturates to the actuators'
bounds; it returns None where the sample stays greedy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from learning.errors import ConfigurationError
from learning.schedule import Linear

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Samples = NDArray[np.int64]
PerturbedPolicy = Callable[[Vector], Vector]
"""Maps a linear cost term on the actions, (m,), to the policy's action under it, (m,)."""


class Strategy(Protocol):
    """An exploration strategy."""

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector | None:
        """Action that explores at a sample, (m,), or None."""

    def bias(self, actions: Matrix, samples: Samples) -> Matrix:
        """E[a − π | explored] of samples with policies π, (K, m): NaN where it is not known.

        It is zero but for saturation.
        """


@dataclass(frozen=True)
class Exploration:
    """What all strategies share.

    `probability` is the share of samples that explore and `deviation` (m,) that of the noise in the
    actions' units, each linear in the sample; `lower` and `upper` (m,) bound the action.
    """

    lower: Vector
    upper: Vector
    probability: Linear
    deviation: Linear

    def noise(self, rng: np.random.Generator, sample: int) -> Vector | None:
        """Draw e ~ N(0, diag σ²), (m,), or None for a greedy sample."""
        # Drawn in every sample, so that paired runs stay in step whatever the probability.
        draw, e = rng.random(), rng.standard_normal(self.lower.size)
        if draw >= float(self.probability(sample)):
            return None
        scaled: Vector = self.deviation(sample) * e
        return scaled

    def saturated_mean(self, centres: Matrix, samples: Samples) -> Matrix:
        """Mean of sat(c + e) − c, (K, m), by the moments of the censored normal distribution."""
        sigma = np.maximum(self.deviation.at(samples), np.finfo(float).tiny)
        low, high = (self.lower - centres) / sigma, (self.upper - centres) / sigma
        density = (np.exp(-(low**2) / 2) - np.exp(-(high**2) / 2)) / np.sqrt(2 * np.pi)
        mean: Matrix = sigma * (density + low * ndtr(low) + high * ndtr(-high))
        return mean


@dataclass(frozen=True)
class Additive(Exploration):
    """a = sat(π(s) + e), e ~ N(0, diag σ²), on a share of the samples."""

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector | None:
        """Action that explores, (m,), or None."""
        e = self.noise(rng, sample)
        return None if e is None else action + e

    def bias(self, actions: Matrix, samples: Samples) -> Matrix:
        """Mean of sat(π + e) − π, (K, m)."""
        return self.saturated_mean(actions, samples)


@dataclass(frozen=True)
class Literal(Exploration):
    """a = sat(e), as the paper prints it: the policy's action is replaced, not perturbed."""

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector | None:
        """Action that explores, (m,), or None."""
        return self.noise(rng, sample)

    def bias(self, actions: Matrix, samples: Samples) -> Matrix:
        """Mean of sat(e) − π, (K, m)."""
        return self.saturated_mean(np.zeros_like(actions), samples) - actions


@dataclass(frozen=True)
class PerturbedCost(Exploration):
    """The policy of a cost with a random linear term dᵀu in each stage, d ~ N(0, diag σ²).

    The perturbed policy obeys every constraint that the policy obeys, so nothing saturates; σ is
    in units of cost per unit of action.
    """

    def __call__(
        self, action: Vector, rng: np.random.Generator, sample: int, perturbed: PerturbedPolicy
    ) -> Vector | None:
        """Action that explores, (m,), or None."""
        d = self.noise(rng, sample)
        return None if d is None else perturbed(d)

    def bias(self, actions: Matrix, samples: Samples) -> Matrix:
        """Not known in closed form: NaN, (K, m)."""
        return np.full_like(actions, np.nan)


STRATEGIES: dict[str, type[Additive | Literal | PerturbedCost]] = {
    "additive": Additive,
    "literal": Literal,
    "perturbed-cost": PerturbedCost,
}


def strategy(
    kind: str, lower: Vector, upper: Vector, probability: Linear, deviation: Linear
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
