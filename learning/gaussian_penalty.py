"""The expected penalty of a state that is known as an estimate and the variance of its error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

from cosim.core.protocols import Array
from cosim.core.scenario import Penalty


def expected_penalties_with_errors(
    penalty: Penalty,
    means: Array,
    variances: Array,
    errors: Sequence[Array],
    n_normal: float,
) -> Array:
    """The same where some errors of estimates are known, besides a normal law.

    The law is the mean of a Dirichlet process about the normal one: each error that was seen
    counts as one, the normal law as `n_normal`.

    Args:
        penalty: bounds and weights.
        means: estimates μ, (K, n).
        variances: σ², (K, n).
        errors: of each state, over their expected deviations, (M_i,).
        n_normal: weight of the normal law.

    Returns:
        Penalties of the lower, then of the upper bounds, (2n, K).
    """
    n = means.shape[1]
    penalties = normal_penalties(penalty, means, variances)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    for i, seen in enumerate(errors):
        states = means[:, i, None] + deviations[:, i, None] * seen
        for row, excess in ((i, penalty.lower[i] - states), (n + i, states - penalty.upper[i])):
            violation = np.maximum(excess, 0.0)
            total = penalty.linear[i] * violation + penalty.quadratic[i] * violation**2
            by_law = n_normal * penalties[row]
            penalties[row] = (by_law + total.sum(axis=1)) / (n_normal + len(seen))
    return penalties


def normal_penalties(penalty: Penalty, means: Array, variances: Array) -> Array:
    """E[b v + B v²] of each bound, the state normal about its estimate.

    With z = (x_l − μ)/σ the violation of a lower bound has E[v] = σ(zΦ(z) + φ(z)) and
    E[v²] = σ²((1 + z²)Φ(z) + zφ(z)); an upper bound is the same from its other side.

    Args:
        penalty: bounds and weights.
        means: estimates μ, (K, n).
        variances: σ², (K, n).

    Returns:
        Penalties of the lower, then of the upper bounds, (2n, K).
    """
    # A variance of zero, or below it by rounding, is a state that is known: the limit holds.
    least = np.finfo(np.float64).tiny
    deviations = np.maximum(np.sqrt(np.maximum(variances, 0.0)), least)
    below = penalty.lower - means
    above = means - penalty.upper
    both = []
    for excess in (below, above):
        z = np.clip(excess / deviations, -1e6, 1e6)
        density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
        probability = ndtr(z)
        violation = np.maximum(excess * probability + deviations * density, 0.0)
        square = (excess**2 + deviations**2) * probability + excess * deviations * density
        both.append(penalty.linear * violation + penalty.quadratic * np.maximum(square, 0.0))
    return np.concatenate(both, axis=1).T
