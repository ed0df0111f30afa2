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
    # A variance may be below zero by rounding.
    deviations = np.sqrt(np.maximum(variances, 0.0))
    for i, seen in enumerate(errors):
        # The states (K, M_i) that an estimate would have had with each error that was seen.
        mean = means[:, i, None]
        deviation = deviations[:, i, None]
        states = mean + deviation * seen
        weight = n_normal + len(seen)
        below = penalty.lower[i] - states
        above = states - penalty.upper[i]
        for row, excess in ((i, below), (n + i, above)):
            violation = np.maximum(excess, 0.0)
            linear = penalty.linear[i] * violation
            quadratic = penalty.quadratic[i] * violation**2
            total = linear + quadratic
            by_law = n_normal * penalties[row]
            by_errors = total.sum(axis=1)
            penalties[row] = (by_law + by_errors) / weight
    return penalties


def normal_penalties(
    penalty: Penalty,
    means: Array,
    variances: Array,
) -> Array:
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
    deviations = np.sqrt(np.maximum(variances, 0.0))
    deviations = np.maximum(deviations, least)
    below = penalty.lower - means
    above = means - penalty.upper
    both = []
    for excess in (below, above):
        # The limits keep z² finite; φ is zero and Φ is 0 or 1 long before them.
        z = np.clip(excess / deviations, -1e6, 1e6)
        density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
        probability = ndtr(z)

        # E[v] and E[v²]; far inside the bound rounding may leave less than nothing.
        mean = excess * probability + deviations * density
        mean = np.maximum(mean, 0.0)
        mean_square = (excess**2 + deviations**2) * probability + excess * deviations * density
        mean_square = np.maximum(mean_square, 0.0)
        linear = penalty.linear * mean
        quadratic = penalty.quadratic * mean_square
        both.append(linear + quadratic)
    by_sample = np.concatenate(both, axis=1)
    return by_sample.T
