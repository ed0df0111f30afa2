"""The optimum where a disturbance has a memory, against Riccati's equation of the larger plant."""

import numpy as np
import pytest
import scipy.linalg

from controllers.dynamic_programming import Settings, simulate_policy, solve
from tests.helpers.linear_plant import LinearPlant

PHI = 0.7


@pytest.mark.slow
def test_the_mean_cost_is_riccatis() -> None:
    """x₊ = Ax + Bu + E d with d = σ ξ₊, ξ₊ = φ ξ + √(1 − φ²) w: the state is (x, ξ)."""
    sigma = 0.1
    linear = LinearPlant([[0.1]], [[0.8]], [[1.0]], [[1.0]], [[0.5]], [sigma])
    gain = np.sqrt(1 - PHI**2)
    A = np.block([[linear.A, sigma * PHI * linear.E], [np.zeros((1, 1)), PHI * np.eye(1)]])
    B = np.vstack([linear.B, [[0.0]]])
    noise = np.vstack([sigma * gain * linear.E, [[gain]]])
    Q = np.diag([1.0, 0.0])
    P = scipy.linalg.solve_discrete_are(A, B, Q, linear.R)
    expected = float((noise.T @ P @ noise).item())

    plant = linear.plant.with_memory(0, PHI)
    optimum = solve(plant, Settings(cells=8))
    assert optimum.gain == pytest.approx(expected, rel=1e-6)
    mean, half_width = simulate_policy(plant, optimum, paths=500, steps=1000)
    assert mean == pytest.approx(expected, abs=2 * half_width)
    # A feedback that forgets what the disturbance was pays more.
    K = np.hstack([linear.riccati()[1], [[0.0]]])
    closed_loop = A + B @ K
    covariance = scipy.linalg.solve_discrete_lyapunov(closed_loop, noise @ noise.T)
    forgetful = np.trace((Q + K.T @ linear.R @ K) @ covariance)
    assert optimum.gain < 0.7 * forgetful
