"""The actor-critic: LSTDV and LSTDQ against exact values, and the step that they lead to."""

import numpy as np
import pytest

from controllers.theta import Parameters
from learning import ActorCritic
from learning.actor_critic import lstdv, regression
from learning.algorithm import Transition
from learning.exploration import Strategy
from tests.helpers.training import Carrier


class Solution:
    def __init__(self, action, jacobian):
        self.action, self.policy_jacobian = action, jacobian


def algorithm(problem, scenario, **settings):
    configuration = ActorCritic.Configuration(
        batch_size=400, forgetting=0.0, parametrisation="paper", **settings
    )
    carrier = Carrier(Parameters.naive(problem))
    strategy = Strategy(configuration, scenario)
    return carrier, ActorCritic(
        carrier, scenario, configuration, 4000, strategy, np.random.default_rng(0)
    )


def feed(actor, carrier, rng, slope, action, *, noise=0.0, clip=None):
    """Samples whose cost is linear in the applied action; only b_l's actions move the policy."""
    size, where = carrier.theta.size, carrier.parameters.blocks.slices["b_l"]
    jacobian = np.zeros((2, size))
    jacobian[0, where.stop - 2], jacobian[1, where.stop - 1] = -0.5, -0.5
    solution = Solution(action, jacobian)
    update = None
    for number in range(400):
        a = action + 5.0 * rng.normal(size=2)
        a = a if clip is None else np.minimum(a, clip)
        s = rng.normal(size=2)
        cost = 6000.0 + slope @ (a - action) + noise * rng.normal()
        before = (number, s, a, True, solution, solution, cost, cost)
        after = (rng.normal(size=2), 0.0, solution, None, None)
        update = actor.observe(Transition(*before, *after))
    return update


def test_the_step_moves_the_policy_down_the_costs_slope(problem, scenario, rng):
    carrier, actor = algorithm(problem, scenario)
    where = carrier.parameters.blocks.slices["b_l"]
    before = carrier.theta[where].copy()
    update = feed(actor, carrier, rng, np.array([3.0, -1.0]), np.array([200.0, 200.0]))
    change = (carrier.theta[where] - before)[2:] * -0.5
    assert change[0] < 0 < change[1]
    assert change[0] / change[1] == pytest.approx(-3.0, rel=0.1)
    assert update is not None


def test_the_trust_region_bounds_the_rms_change_of_the_action(problem, scenario, rng):
    carrier, actor = algorithm(problem, scenario, radius=0.4, radius_end=0.4)
    where = carrier.parameters.blocks.slices["b_l"]
    before = carrier.theta[where].copy()
    feed(actor, carrier, rng, np.array([30.0, -10.0]), np.array([200.0, 200.0]))
    assert np.linalg.norm((carrier.theta[where] - before)[2:] * -0.5) == pytest.approx(0.4 * 5)


def test_saturation_does_not_bias_the_gradient(problem, scenario, rng):
    """At a saturated action the noise has a mean; a level of cost must not look like a slope."""
    action = np.array([399.0, 200.0])
    carrier, actor = algorithm(problem, scenario)
    feed(actor, carrier, rng, np.zeros(2), action, noise=1.0, clip=scenario.action_upper)
    raw_mean = -5.0 * 0.3  # what the noise would average to, roughly
    assert abs(actor._deviation()[:, 0].mean()) < 0.25 * abs(raw_mean)


def chain(rng, count=40_000):
    """A stable linear chain with a quadratic cost, where LSTD's features are exact."""
    A = np.array([[0.8, 0.1], [-0.2, 0.7]])
    states = np.empty((count + 1, 2))
    states[0] = 0.0
    for k in range(count):
        states[k + 1] = A @ states[k] + rng.normal(size=2)
    return A, states[:-1], states[1:]


def test_lstdv_errors_are_those_of_the_exact_value(rng):
    A, s, t = chain(rng)
    P = np.eye(2)
    for _ in range(2000):
        P = np.eye(2) + A.T @ P @ A
    reward = (s**2).sum(axis=1)
    value, following = np.einsum("ki,ij,kj->k", s, P, s), np.einsum("ki,ij,kj->k", t, P, t)
    level = np.trace(P)
    exact = reward + following - value - level
    errors = lstdv(s, t, reward)
    assert errors.mean() == pytest.approx(0.0, abs=1e-8)
    assert np.corrcoef(errors, exact)[0, 1] > 0.998


def test_advantage_regression_finds_the_weights(rng):
    features = rng.normal(size=(500, 4)) * [1.0, 10.0, 0.1, 0.0]
    weights = np.array([1.0, -0.2, 3.0, 7.0])
    # A direction in which the policy does not move tells nothing and gets nothing.
    found = regression(features.T @ features, features.T @ (features @ weights), 1e-9)
    assert found == pytest.approx([1.0, -0.2, 3.0, 0.0], abs=1e-4)
