"""Errors that persist, r₊ = Φ r + e: the first-order autoregression of a model's prediction errors.

A disturbance that lasts for more than a sample makes errors that are correlated in time. Their mean
over a window is then less certain than that of as many independent ones, and what they were in one
sample says something of the next.
"""

from __future__ import annotations

import numpy as np

from cosim.core.protocols import Array, Matrix

DOUBLINGS = 12
"""Rounds of the sum Γ, 2¹² terms: at the largest radius what is left out is below rounding."""


def estimate_persistence(
    later: Array,
    before: Array,
    earlier: Array,
    n_earlier: int,
    *,
    doubt: float,
    largest: float = 0.99,
) -> Array:
    """Φ by least squares; zero where independent errors would look like it.

    The likelihood ratio of Φ = 0 is a χ² of K² degrees of freedom where the errors are independent:
    of mean K² and variance 2K².

    Args:
        later: r₊, (M, K).
        before: r, (M, K).
        earlier: an earlier estimate of Φ, (K, K), which counts as if it came from these errors.
        n_earlier: number of errors of which that was one.
        doubt: standard deviations by which the ratio must exceed its mean.
        largest: largest spectral radius of Φ; errors that last longer are a mean.

    Returns:
        Φ, (K, K).
    """
    later = later - later.mean(axis=0)
    before = before - before.mean(axis=0)
    count, K = before.shape
    # In units of their size; an output without errors has none that persist.
    size = before.std(axis=0)
    size = np.where(size > 0, size, 1.0)
    scaled_later = later / size
    scaled_before = before / size
    solution, *_ = np.linalg.lstsq(scaled_before, scaled_later, rcond=1e-8)
    weight = n_earlier / (count + n_earlier)
    # Rows of errors multiply from the left: Φᵀ, in the units of the scaled errors.
    scaled_earlier = earlier.T * size[:, None] / size
    solution = (1 - weight) * solution + weight * scaled_earlier

    # Log-likelihoods of normal errors, with and without what persists.
    innovations = scaled_later - scaled_before @ solution
    without = _log_determinant(scaled_later)
    with_persistence = _log_determinant(innovations)
    gain = without - with_persistence
    ratio = count * gain
    degrees = K**2
    deviation = (2 * degrees) ** 0.5
    # An earlier estimate has passed this test.
    looks_independent = ratio <= degrees + doubt * deviation
    if looks_independent and not weight:
        return np.zeros((K, K))

    in_own_units = solution / size[:, None] * size
    persistence: Array = in_own_units.T
    radius = max(_radius(persistence), 1e-9)
    shrinkage = min(1.0, largest / radius)
    return persistence * shrinkage


def _log_determinant(values: Array) -> float:
    """Log of the determinant of the covariance of values (M, K), of mean zero."""
    covariance = values.T @ values / len(values)
    floor = 1e-12 * np.eye(len(covariance))
    _, logarithm = np.linalg.slogdet(covariance + floor)
    return float(logarithm)


def _radius(persistence: Array) -> float:
    """The spectral radius."""
    eigenvalues = np.linalg.eigvals(persistence)
    return float(np.abs(eigenvalues).max())


def error_covariance(persistence: Array, innovations: Array) -> Array:
    """Covariance of r, (K, K), which solves Γ = Φ Γ Φᵀ + Σ.

    Args:
        persistence: Φ, (K, K).
        innovations: Σ, the covariance of e, (K, K).
    """
    if not persistence.any():
        return innovations
    # Γ = Σ_k Φᵏ Σ Φᵏᵀ, twice as many terms in each round. The equation itself is ill-conditioned
    # where an output has hardly any noise: Φ then has entries of any size.
    covariance = innovations
    power = persistence
    for _ in range(DOUBLINGS):
        covariance = covariance + power @ covariance @ power.T
        power = power @ power
    return covariance


def mean_error_covariance(
    persistence: Array,
    innovations: Array,
    count: int,
) -> Array:
    """Covariance of the mean of consecutive r: Γ/T + Σ_k (1 − k/T) (Φᵏ Γ + Γ Φᵏᵀ)/T, k from 1.

    Args:
        persistence: Φ, (K, K).
        innovations: Σ, the covariance of e, (K, K).
        count: T, the number of r.

    Returns:
        The covariance, (K, K); of independent errors Σ/T.
    """
    if not persistence.any():
        return innovations / count
    gamma = error_covariance(persistence, innovations)
    # Σ_k (1 − k/T) Φᵏ in closed form.
    one = np.eye(len(persistence))
    inverse = np.linalg.inv(one - persistence)
    power = np.linalg.matrix_power(persistence, count)
    remainder = persistence @ (one - power) @ inverse @ inverse / count
    total = persistence @ inverse - remainder
    later = total @ gamma
    earlier = gamma @ total.T
    covariance: Array = (gamma + later + earlier) / count
    return covariance


def effective_number(persistence: Array, count: int) -> float:
    """Number of independent errors that say as much as so many consecutive ones.

    That of a scalar autoregression with the spectral radius ρ of Φ, count (1 − ρ)/(1 + ρ).

    Args:
        persistence: Φ, (K, K).
        count: of errors.
    """
    radius = _radius(persistence) if persistence.any() else 0.0
    return count * (1 - radius) / (1 + radius)


def linear_part(states: Matrix, errors: Matrix) -> Matrix:
    """The part of errors that is affine in the states, by least squares.

    Args:
        states: s, (K, n).
        errors: e, (K, n).

    Returns:
        The affine part, (K, n).
    """
    spread = states.std(axis=0)
    unit = np.where(spread > 0, spread, 1.0)
    z = (states - states.mean(axis=0)) / unit
    ones = np.ones((len(z), 1))
    features = np.hstack([ones, z])
    coefficients, *_ = np.linalg.lstsq(features, errors)
    part: Matrix = features @ coefficients
    return part
