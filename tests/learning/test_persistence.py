"""Errors that persist, against theory."""

import numpy as np
import pytest

from learning.persistence import (
    effective_number,
    error_covariance,
    estimate_persistence,
    mean_error_covariance,
)

PHI = np.array([[0.7, 0.2], [-0.1, 0.5]])
SIGMA = np.array([[1.0, 0.3], [0.3, 0.5]])
NONE = np.zeros((2, 2))


def autoregression(rng, count, phi):
    """Consecutive errors r₊ = Φ r + e."""
    noise = rng.multivariate_normal(np.zeros(2), SIGMA, count)
    errors = np.zeros((count, 2))
    for k in range(1, count):
        errors[k] = phi @ errors[k - 1] + noise[k]
    return errors


def test_the_autoregression_is_found(rng):
    errors = autoregression(rng, 20_000, PHI)
    assert estimate_persistence(errors[1:], errors[:-1], NONE, 0, doubt=4.0) == pytest.approx(
        PHI, abs=0.03
    )


def test_independent_errors_do_not_persist(rng):
    errors = autoregression(rng, 500, NONE)
    assert not estimate_persistence(errors[1:], errors[:-1], NONE, 0, doubt=4.0).any()


def test_an_earlier_estimate_counts_like_errors_seen_here(rng):
    errors = autoregression(rng, 21, NONE)
    found = estimate_persistence(errors[1:], errors[:-1], PHI, 2000, doubt=4.0)
    assert found == pytest.approx(PHI, abs=0.02)


def test_the_covariance_solves_lyapunovs_equation():
    gamma = error_covariance(PHI, SIGMA)
    assert gamma == pytest.approx(PHI @ gamma @ PHI.T + SIGMA)


def test_an_output_with_hardly_any_noise_has_its_covariance_too():
    scale = np.diag([1.0, 1e-60])
    phi = scale @ PHI @ np.linalg.inv(scale)
    gamma = error_covariance(phi, scale @ SIGMA @ scale)
    expected = scale @ error_covariance(PHI, SIGMA) @ scale
    np.testing.assert_allclose(gamma, expected, rtol=1e-12)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_the_covariance_of_a_mean_is_the_sum_of_all_covariances(count):
    gamma = error_covariance(PHI, SIGMA)
    total = np.zeros((2, 2))
    for i in range(count):
        for j in range(count):
            power = np.linalg.matrix_power(PHI, abs(i - j))
            total += power @ gamma if i >= j else gamma @ power.T
    assert mean_error_covariance(PHI, SIGMA, count) == pytest.approx(total / count**2)


def test_the_effective_number_is_that_of_a_scalar_autoregression():
    gamma = error_covariance(np.array([[0.9]]), np.array([[1.0]]))
    variance = mean_error_covariance(np.array([[0.9]]), np.array([[1.0]]), 10_000)
    independent = float(gamma[0, 0] / variance[0, 0])
    assert effective_number(np.array([[0.9]]), 10_000) == pytest.approx(independent, rel=0.01)
    assert effective_number(NONE, 30) == 30
