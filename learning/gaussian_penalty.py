"""The expected penalty of a state that is known as an estimate and the variance of its error."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from cosim.core.protocols import Array
from cosim.core.scenario import Penalty


def expected_penalties(penalty: Penalty, means: Array, variances: Array) -> Array:
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
    # Zero deviation is a state that is known: the formulas hold in its limit.
    deviations = np.maximum(np.sqrt(variances), np.finfo(np.float64).tiny)
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
