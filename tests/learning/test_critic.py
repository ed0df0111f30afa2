import numpy as np
import pytest

from learning.actor_critic import AdvantageRegression, lstdv, quadratic_features


def chain(rng, count=40_000):
    """A stable linear chain with a quadratic cost, where LSTD's features are exact."""
    A = np.array([[0.8, 0.1], [-0.2, 0.7]])
    states = np.empty((count + 1, 2))
    states[0] = 0.0
    for k in range(count):
        states[k + 1] = A @ states[k] + rng.normal(size=2)
    return A, states[:-1], states[1:]


def test_quadratic_features_of_two_states():
    row = quadratic_features(np.array([[3.0, 5.0]]), np.array([1.0, 1.0]), np.array([2.0, 4.0]))
    assert row.tolist() == [[1.0, 1.0, 1.0, 1.0, 1.0, 1.0]]
    assert quadratic_features(
        np.array([[5.0, 5.0]]), np.ones(2), np.array([2.0, 4.0])
    ).tolist() == [[1.0, 2.0, 1.0, 4.0, 2.0, 1.0]]


@pytest.mark.parametrize("discount", [0.9, 1.0])
def test_lstdv_errors_are_those_of_the_exact_value(rng, discount):
    A, s, t = chain(rng)
    P = np.eye(2)
    for _ in range(2000):
        P = np.eye(2) + discount * A.T @ P @ A
    reward = (s**2).sum(axis=1)
    value, following = np.einsum("ki,ij,kj->k", s, P, s), np.einsum("ki,ij,kj->k", t, P, t)
    level = discount * np.trace(P)
    exact = reward + discount * following - value - level
    errors = lstdv(s, t, reward, discount)
    assert errors.mean() == pytest.approx(0.0, abs=1e-8)
    assert np.corrcoef(errors, exact)[0, 1] > 0.998


def test_advantage_regression_finds_the_weights(rng):
    features = rng.normal(size=(500, 4)) * [1.0, 10.0, 0.1, 0.0]
    weights = np.array([1.0, -0.2, 3.0, 7.0])
    regression = AdvantageRegression(4, 0.0, 1e-9)
    regression.add(features, features @ weights)
    # A direction in which the policy does not move tells nothing and gets nothing.
    assert regression.weights() == pytest.approx([1.0, -0.2, 3.0, 0.0], abs=1e-4)


def test_advantage_regression_forgets_geometrically(rng):
    regression = AdvantageRegression(1, 0.5, 0.0)
    ones = np.ones((1, 1))
    regression.add(ones, np.array([4.0]))
    regression.add(ones, np.array([1.0]))
    assert regression.weights() == pytest.approx([(0.5 * 4.0 + 1.0) / 1.5])
