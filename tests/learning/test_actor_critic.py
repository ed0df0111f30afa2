"""The actor-critic: its gradient against the exact one, its value, and its trust region."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.scenario import Penalty
from learning import ActorCritic
from learning.actor_critic import DifferentialValue, ExpectedPenalty, trust_region_fit
from learning.algorithm import Transition
from learning.errors import DivergenceError
from learning.exploration import Strategy
from tests.helpers.linear_quadratic import ACTION_COST, STATE_COST
from tests.helpers.training import Carrier, looped

NOISE = 0.5


class Kept(ActorCritic):
    """Keeps what each batch says."""

    def gradient(self):
        self.kept = super().gradient()
        return self.kept


def mean_cost(task, controller, theta):
    """The exact J of θ on the plant, by its Lyapunov equation: no bound limits π(s) = o − Ks."""
    controller.theta = theta
    controller.reset()
    solution = controller.feedback(np.zeros(2))
    K, offset = -solution.policy_state_jacobian, solution.action
    closed = task.A - task.B @ K
    mean = np.linalg.solve(np.eye(2) - closed, task.B @ offset)
    covariance = solve_discrete_lyapunov(closed, NOISE**2 * np.eye(2))
    action = offset - K @ mean
    cost = np.trace((STATE_COST + K.T @ ACTION_COST @ K) @ covariance)
    return float(cost + mean @ STATE_COST @ mean + action @ ACTION_COST @ action)


def one_batch(task, rule=Kept, size=2000, **settings):
    """A loop after one batch from a wrong θ, and the θ of the batch."""
    configuration = rule.Configuration.from_dict(
        {"parametrisation": "paper", "value_offset": "stage-cost", "batch_size": size, **settings}
    )
    controller = RtiNmpc(task.problem, task.wrong())
    loop = looped(rule, task.plant(NOISE), controller, configuration, size, seed=7)
    theta = controller.theta.copy()
    for _ in range(size):
        loop.advance()
    return loop, theta


@pytest.fixture(scope="module")
def batch(linear_quadratic):
    return one_batch(linear_quadratic)


def test_the_gradient_is_that_of_the_mean_cost(linear_quadratic, batch):
    loop, theta = batch
    gradient = loop.algorithm.kept[0]
    scale = loop.algorithm._step.scale
    judge = RtiNmpc(linear_quadratic.problem, linear_quadratic.wrong())
    exact = np.empty(theta.size)
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-4 * scale[i]
        above = mean_cost(linear_quadratic, judge, theta + step)
        below = mean_cost(linear_quadratic, judge, theta - step)
        exact[i] = (above - below) / 2e-4
    assert gradient @ exact > 0.99 * np.linalg.norm(gradient) * np.linalg.norm(exact)
    assert np.linalg.norm(gradient) == pytest.approx(np.linalg.norm(exact), rel=0.1)


def test_the_step_lowers_the_mean_cost_within_the_trust_region(linear_quadratic, batch):
    loop, theta = batch
    settings = loop.algorithm.configuration
    step = (loop.controller.theta - theta) / loop.algorithm._step.scale
    metric = loop.algorithm.kept[2]
    change = float(step @ metric @ step) ** 0.5
    assert 0 < change <= settings.radius * (1 + 1e-9)
    assert np.linalg.norm(step) <= settings.largest_step * (1 + 1e-9)
    judge = RtiNmpc(linear_quadratic.problem, linear_quadratic.wrong())
    after = mean_cost(linear_quadratic, judge, loop.controller.theta)
    assert after < mean_cost(linear_quadratic, judge, theta)


def test_a_smaller_radius_makes_a_smaller_change_of_the_action(linear_quadratic):
    loop, theta = one_batch(linear_quadratic, size=200, radius=1e-3)
    step = (loop.controller.theta - theta) / loop.algorithm._step.scale
    change = float(step @ loop.algorithm.kept[2] @ step) ** 0.5
    assert 1e-4 < change <= 1e-3 * (1 + 1e-9)


def test_after_a_retreat_a_batch_is_judged_as_if_it_were_the_first(linear_quadratic):
    """What was seen at the θ that was left, in whole batches and in an open one, has no part."""
    size = 200
    # Short steps, after which the critic would go on knowing what it knew.
    settings = {"exploration_probability": 0.5, "decay_after": 1}
    loop, _ = one_batch(linear_quadratic, size=size, **settings)
    rule = loop.algorithm
    for _ in range(size // 2):
        loop.advance()
    kept = linear_quadratic.wrong().theta
    loop.controller.theta = kept
    rule.retreat()
    loop.renew()
    moved_at = []
    for number in range(1, size + 1):
        if loop.advance()[1] is not None:
            moved_at.append(number)
    assert moved_at == [size], "the open batch has begun anew"
    assert rule._critic.n_samples <= size, "those of one batch alone"
    step = (loop.controller.theta - kept) / rule._step.scale
    assert 0 < np.linalg.norm(step) <= rule.configuration.largest_step * (1 + 1e-9)


class Solution:
    def __init__(self, action, size):
        self.action, self.policy_jacobian = action, np.zeros((2, size))


def saturated(problem, scenario, rng, cost=6000.0, explores=True):
    """A rule whose open batch lacks one sample; each explores at a saturated action."""
    configuration = ActorCritic.Configuration.from_dict(
        {"parametrisation": "paper", "batch_size": 401, "exploration_probability": float(explores)}
    )
    carrier = Carrier(Parameters.naive(problem))
    strategy = Strategy(configuration, scenario)
    actor = ActorCritic(carrier, scenario, configuration, 401, strategy, rng)
    solution = Solution(np.array([399.0, 200.0]), carrier.theta.size)
    for number in range(400):
        wanted = strategy(solution.action, rng) if explores else solution.action
        a = np.clip(wanted, scenario.action_lower, scenario.action_upper)
        s = scenario.initial_state + rng.normal(size=(2, 2))
        before = (number, s[0], a, explores, solution, solution, cost, cost, cost)
        actor.observe(Transition(*before, s[1], 0.0, solution, None, None))
    return actor


def test_saturation_does_not_bias_the_deviation(problem, scenario, rng):
    """At a saturated action the noise has a mean; a level of cost must not look like a slope."""
    actor = saturated(problem, scenario, rng)
    raw_mean = -5.0 * 0.3  # what the noise would average to, roughly
    assert abs(actor._deviation()[:400, 0].mean()) < 0.25 * abs(raw_mean)


def test_costs_that_are_not_finite_are_a_divergence(problem, scenario, rng):
    actor = saturated(problem, scenario, rng, cost=np.nan)
    solution = Solution(np.array([399.0, 200.0]), actor.controller.theta.size)
    s, a = scenario.initial_state, solution.action
    sample = Transition(
        400, s, a, False, solution, solution, 0.0, 0.0, 0.0, s, 0.0, solution, None, None
    )
    with pytest.raises(DivergenceError, match="not finite"):
        actor.observe(sample)


def chain(rng, count=40_000):
    """A stable linear chain with a quadratic cost, where LSTD's features are exact."""
    A = np.array([[0.8, 0.1], [-0.2, 0.7]])
    errors = rng.normal(size=(count, 2)) @ np.array([[1.0, 0.4], [0.0, 0.5]])
    states = np.empty((count + 1, 2))
    states[0] = 0.0
    for k in range(count):
        states[k + 1] = A @ states[k] + errors[k]
    return A, states[:-1], errors


def test_the_value_and_its_slopes_are_the_exact_ones(rng):
    A, states, errors = chain(rng)
    P = np.eye(2)
    for _ in range(2000):
        P = np.eye(2) + A.T @ P @ A
    value = DifferentialValue(2)
    reward = (states**2).sum(axis=1)
    td_errors = value.fit(states, states @ A.T, errors, reward)
    # The next value in expectation: the TD errors of the exact value vanish.
    assert np.abs(td_errors).max() < 1e-6 * reward.max()
    assert value.weights[0] == pytest.approx(
        np.trace(P @ errors.T @ errors) / len(errors), rel=0.02
    )
    assert value.hessian() == pytest.approx(2 * P, rel=1e-6)
    assert value.gradient(states[:5]) == pytest.approx(2 * states[:5] @ P, rel=1e-3, abs=0.2)


def test_the_longer_errors_last_the_less_a_cost_that_follows_the_state_is_a_slope(
    problem, scenario, monkeypatch
):
    """Realised costs that go with the state, as a lasting disturbance makes them."""

    def gradient(redundancy, share):
        rng = np.random.default_rng(0)
        monkeypatch.setattr("learning.actor_critic.redundancy_of", lambda *_: redundancy)
        actor = saturated(problem, scenario, rng, explores=False)
        batch = actor._batch
        batch["s"][400] = batch["next_s"][400] = scenario.initial_state
        batch["policy"][400] = batch["a"][400] = batch["policy"][0]
        batch["cost"] += share * (batch["s"][:, 0] - scenario.initial_state[0])
        batch["jacobian"] = rng.normal(size=batch["jacobian"].shape)
        return actor.gradient().gradient

    changes = [gradient(redundancy, 50.0) - gradient(redundancy, 0.0) for redundancy in (1.0, 4.0)]
    assert np.abs(changes[0]).max() > 0
    # The critic is linear in the costs, so four times as long counts for a quarter.
    largest = np.abs(changes[0]).max()
    np.testing.assert_allclose(changes[1], changes[0] / 4.0, atol=1e-6 * largest)


def test_a_constant_in_the_cost_is_the_mean_cost_and_nothing_else(rng):
    A, states, errors = chain(rng, 500)
    reward = (states**2).sum(axis=1)
    plain, raised = DifferentialValue(2), DifferentialValue(2)
    td_errors = plain.fit(states, states @ A.T, errors, reward)
    assert raised.fit(states, states @ A.T, errors, reward + 1e3) == pytest.approx(
        td_errors, abs=1e-8
    )
    assert raised.weights[0] - plain.weights[0] == pytest.approx(1e3)


def test_slopes_of_the_expected_penalty_are_those_of_a_smooth_hinge(rng):
    """Of normal errors the slope is −b Φ and the curvature b φ, at the lower bound alone."""
    penalty = Penalty([0.0], [np.inf], [3.0], [0.0])
    errors = rng.normal(size=(20_000, 1))
    slope, curvature = ExpectedPenalty(penalty, errors).slopes(np.array([[0.0], [1.0], [8.0]]))
    assert slope[:, 0] == pytest.approx([-3 * 0.5, -3 * 0.1587, 0.0], abs=0.04)
    assert curvature[:, 0, 0] == pytest.approx([3 * 0.399, 3 * 0.242, 0.0], abs=0.1)


@pytest.mark.parametrize("radius", [1e-3, 0.1, 1e3])
def test_the_fit_is_the_minimum_in_the_trust_region(rng, radius):
    """Karush, Kuhn and Tucker: (H + μR)d = −g, μ ≥ 0, and μ = 0 where the step is inside."""
    for _ in range(20):
        roots = rng.normal(size=(2, 6, 6)) * np.geomspace(1.0, 1e-2, 6)
        hessian = roots[0] @ roots[0].T
        region = roots[1] @ roots[1].T + 1e-3 * np.eye(6)
        gradient = rng.normal(size=6)
        step = trust_region_fit(gradient, hessian, region, radius).minimiser
        length = float(step @ region @ step) ** 0.5
        assert length <= radius * (1 + 1e-6)
        push = -gradient - hessian @ step
        multiplier = float(push @ step) / length**2
        assert multiplier >= -1e-6 * np.abs(hessian).max()
        assert push == pytest.approx(multiplier * region @ step, abs=1e-5 * np.abs(gradient).max())
        if length < 0.999 * radius:
            assert np.linalg.norm(push) < 1e-5 * np.linalg.norm(gradient)


def test_a_long_direction_does_not_shorten_the_others():
    hessian = np.diag([1.0, 1e-9])
    gradient = np.array([-1e-3, -1.0])
    step = trust_region_fit(gradient, hessian, np.diag([1e-2, 1.0]), 1.0).minimiser
    # Scaled as a whole, the first entry would be 1e-12.
    assert step == pytest.approx([1e-3, 1.0], rel=0.05)


def test_without_curvature_only_the_region_bounds_the_step():
    fit = trust_region_fit(np.array([0.0, 2.0]), np.zeros((2, 2)), np.eye(2), 0.5)
    assert fit.minimiser == pytest.approx([0.0, -0.5])
    still = trust_region_fit(np.zeros(2), np.zeros((2, 2)), np.eye(2), 0.5)
    assert still.minimiser == pytest.approx([0.0, 0.0])
