"""Online Q-learning: the printed rule in closed form, the Kalman recursion, the mean cost."""

import numpy as np
import pytest

from controllers.rti import RtiNmpc
from learning import QLearning
from learning.q_learning import AverageCost, KalmanRegression, redundancy_of
from learning.step import Fit
from learning.training_run import starting_parameters
from tests.helpers.training import looped

AS_PRINTED = {
    "rule": "fit",
    "step_size": 1e-3,
    "scaled": False,
    "exploration": "additive",
    "exploration_probability": 0.1,
    "exploration_deviation": [3.1622776601683795],
    "value_offset": "stage-cost",
    "parametrisation": "paper",
}
"""The rule as the paper prints it (paper.tex, Simulations)."""


class Bench:
    """QLearning on the evaporator, a sample at a time."""

    def __init__(self, plant, problem, **settings):
        self.scenario = plant.scenario
        configuration = QLearning.Configuration.from_dict(settings)
        self.controller = RtiNmpc(problem, starting_parameters(problem, configuration))
        self.interaction = looped(QLearning, plant, self.controller, configuration, seed=11)
        self.algorithm = self.interaction.algorithm


def test_the_papers_rule_takes_the_closed_form_step(plant, problem):
    bench = Bench(plant, problem, **AS_PRINTED)
    sample, _ = bench.interaction.next()
    delta = sample.cost + plant.scenario.discount * sample.next_solution.value
    delta -= sample.q_solution.value
    gradient = sample.q_solution.value_gradient
    expected = 1e-3 * delta * gradient / (1 + 1e-3 * gradient @ gradient)
    before = bench.controller.theta.copy()
    update = bench.algorithm.observe(sample)
    assert bench.controller.theta - before == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert update.td_error == pytest.approx(abs(delta))


def regression(size, variance, **changes):
    settings = {"clip": np.inf, "memory": np.inf, **changes}
    return KalmanRegression(size, variance, **settings)


@pytest.fixture
def data(rng):
    gradient = rng.normal(size=(60, 4))
    return gradient, gradient @ np.array([1.0, -2.0, 0.5, 0.0]) + 0.3 * rng.normal(size=60)


def test_the_recursion_is_the_batch_ridge_regression(data):
    gradient, errors = data
    kalman = regression(4, 0.7)
    for row, error in zip(gradient, errors, strict=True):
        kalman.update(error, row)
    information = np.eye(4) + gradient.T @ gradient / 0.7
    assert kalman.mean == pytest.approx(np.linalg.solve(information, gradient.T @ errors / 0.7))
    assert kalman.covariance == pytest.approx(np.linalg.inv(information))
    fit = kalman.step()
    assert fit.metric() == pytest.approx(information)
    assert fit.metric() @ fit.minimiser == pytest.approx(fit.gradient)


def test_noise_that_lasts_counts_as_so_much_more_noise(data):
    gradient, errors = data
    kalman, noisier = regression(4, 0.7), regression(4, 2.1)
    kalman.redundancy = 3.0
    for row, error in zip(gradient, errors, strict=True):
        kalman.update(error, row)
        noisier.update(error, row)
    assert kalman.mean == pytest.approx(noisier.mean)
    assert kalman.covariance == pytest.approx(noisier.covariance)


@pytest.mark.parametrize("memory", [0.5, 0.8, 0.9])
def test_redundancy_is_that_of_the_mean_of_an_autoregression(rng, memory):
    """Var of the mean of K errors is σ²/K·(1 + ρ)/(1 − ρ)."""
    errors = np.zeros((4000, 2))
    for k in range(1, len(errors)):
        errors[k] = memory * errors[k - 1] + rng.normal(size=2) * [1.0, 1e-3]
    states = rng.normal(size=errors.shape)
    assert redundancy_of(states, errors, 4.0) == pytest.approx((1 + memory) / (1 - memory), rel=0.3)


def test_independent_errors_are_not_redundant(rng):
    for _ in range(20):
        states, errors = rng.normal(size=(2, 500, 2)) * [1.0, 1e-3]
        assert redundancy_of(states, errors, 4.0) == 1.0
    assert redundancy_of(np.ones((3, 2)), np.ones((3, 2)), 4.0) == 1.0


def test_errors_of_a_wrong_model_are_not_redundant(rng):
    """The state of a slow plant lasts, and so do errors that follow it."""
    states = np.zeros((500, 2))
    for k in range(1, len(states)):
        states[k] = 0.9 * states[k - 1] + rng.normal(size=2)
    errors = 0.5 * states + rng.normal(size=(500, 2))
    assert redundancy_of(states, errors, 4.0) == 1.0


def test_an_outlier_moves_no_further_than_the_clip():
    far, clipped = regression(1, 4.0), regression(1, 4.0, clip=3.0)
    far.update(6.0, np.ones(1))
    clipped.update(1e9, np.ones(1))
    assert clipped.mean == pytest.approx(far.mean)


def test_a_step_that_is_too_long_is_cut_and_so_is_what_it_tells(data):
    gradient, errors = data
    free, cut = regression(4, 0.7), regression(4, 0.7, largest=0.5)
    for row, error in zip(gradient, errors, strict=True):
        free.update(error, row)
        cut.update(error, row)
    step = free.step().minimiser
    share = 0.5 / np.abs(step).max()
    assert share < 1
    assert cut.step().minimiser == pytest.approx(share * step)
    assert cut.covariance == pytest.approx((1 - share) * np.eye(4) + share * free.covariance)


def test_drift_lets_a_parameter_be_followed(rng):
    still, following = regression(1, 0.1), regression(1, 0.1, drift=1e-3)
    for k in range(4000):
        truth = 1.0 if k < 2000 else -1.0
        for kalman in (still, following):
            kalman.update(truth + 0.1 * rng.normal(), np.ones(1))
    assert following.mean[0] == pytest.approx(-1.0, abs=0.1)
    assert abs(still.mean[0]) < 0.2


def fit():
    metric = np.array([[2.0, 0.5], [0.5, 1.0]])
    minimiser = np.array([0.3, -0.4])
    return Fit(metric @ minimiser, minimiser, lambda: metric)


def test_discounted_target_and_untouched_fit():
    average_cost = AverageCost(0.9, 1, 10.0, 6000.0)
    assert average_cost.target(5.0, 100.0) == 95.0
    same = fit()
    assert average_cost.absorb(same) is same


def test_a_mean_cost_that_follows_the_td_error_is_no_part_of_the_fit():
    average_cost = AverageCost(1.0, 1, 10.0, 6000.0, 4)
    average_cost.follow(8.0)
    assert average_cost.mean_cost == 6002.0
    assert average_cost.without_level(np.ones(3)).tolist() == [1.0, 0.0, 1.0]
    fitted = AverageCost(1.0, 1, 10.0, 6000.0)
    fitted.follow(8.0)
    assert (fitted.mean_cost, fitted.without_level(np.ones(3)).tolist()) == (6000.0, [1.0] * 3)


def test_a_level_of_the_td_error_is_not_paid_into_theta(rng):
    """An oracle: least squares with an intercept, whose slopes do not depend on a level."""
    gradient = np.ones((3000, 3))  # the last entry is that of c_lambda
    gradient[:, :2] = rng.normal([2.0, -0.5], size=(3000, 2))
    errors = 3.0 + gradient @ [0.3, -0.2, 0.0] + 0.1 * rng.normal(size=3000)
    slopes = np.linalg.lstsq(gradient, errors)[0][:2]
    learned = {}
    for memory in (0, 20):
        average_cost = AverageCost(1.0, 2, 1.0, 0.0, memory=50, gradient_memory=memory)
        kalman = regression(3, 1.0)
        for row, error in zip(gradient, errors, strict=True):
            kalman.update(error, average_cost.without_level(row))
        assert kalman.mean[2] == pytest.approx(0.0, abs=1e-12)
        learned[memory] = kalman.mean[:2]
    assert learned[20] == pytest.approx(slopes, abs=0.1)
    assert np.abs(learned[0] - slopes).max() > 0.5


def test_a_batch_without_its_means_is_fitted_with_an_intercept(rng):
    gradient = rng.normal([2.0, -0.5, 1.0], [1.0, 1.0, 0.0], size=(50, 3))
    errors = 3.0 + gradient @ [0.3, -0.2, 0.0] + rng.normal(size=50)
    average_cost = AverageCost(1.0, 2, 1.0, 100.0)
    centred, slopes = average_cost.centre(errors, gradient)
    with_intercept = np.linalg.lstsq(gradient, errors)[0]
    assert np.linalg.lstsq(slopes[:, :2], centred)[0] == pytest.approx(with_intercept[:2])
    assert average_cost.mean_cost == pytest.approx(100.0 + errors.mean())
    discounted = AverageCost(0.9, 2, 1.0, 100.0).centre(errors, gradient)
    assert discounted[0] is errors and discounted[1] is gradient


def test_the_first_samples_give_the_mean_cost_and_what_is_left_of_their_td_errors():
    levels = np.array([6010.0, 6020.0, 6060.0])
    average_cost = AverageCost(1.0, 1, 10.0, 0.0)
    assert average_cost.begin(levels).tolist() == [-20.0, -10.0, 30.0]
    assert average_cost.mean_cost == 6030.0
    assert AverageCost(0.9, 1, 10.0, 0.0).begin(levels).tolist() == levels.tolist()


def test_mean_cost_takes_the_step_of_c_lambda():
    average_cost = AverageCost(1.0, 1, 10.0, 6000.0)
    assert average_cost.target(6001.0, 100.0) == 101.0
    rest = average_cost.absorb(fit())
    assert average_cost.mean_cost == pytest.approx(6000.0 - 4.0)
    assert rest.minimiser.tolist() == [0.3, 0.0]
    assert rest.gradient == pytest.approx(rest.metric() @ rest.minimiser)
