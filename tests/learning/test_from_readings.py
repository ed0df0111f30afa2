"""Learning from a log of readings: what is refused, what is predicted, and that it is true."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from controllers.errors import ModelWarning
from controllers.estimator import ExtendedKalmanFilter
from cosim import FmuPlant, Scenario, build_controller, simulate
from cosim.core.logged_data import LoggedDataError, read_log
from cosim.core.logged_readings import readings_of
from cosim.core.simulation import indicators_of
from cosim.core.statistics import mean
from learning import ConfigurationError, train_from_data
from learning.from_readings import _warn_of_noise, _warn_of_persistence, follow
from learning.innovations import Stretch, fit_noise, loss_of_noise, noise_covariance
from learning.log_configuration import LogConfiguration
from learning.log_prediction import difference_of_separate
from tests.learning.test_model_from_outputs import linear_readings

QUICK = {
    "fit_noise_rounds": 6,
    "simulated_samples": 600,
    "coarse_rollout": 600,
    "output_samples": 1500,
}


@pytest.fixture(scope="module")
def assay():
    return Scenario.load("assay")


@pytest.fixture(scope="module")
def log(assay, tmp_path_factory):
    """1500 samples of `assay` under its cautious NMPC."""
    file = tmp_path_factory.mktemp("log") / "log.csv"
    with FmuPlant(assay) as plant:
        simulate(plant, build_controller("cautious", assay), 1500, 3).write_csv(file)
    return readings_of(read_log(file, assay, given=assay.measurement_names), assay)


def test_the_posterior_is_as_wide_as_the_loss_is_curved():
    """Independent: second differences of the loss itself, in random directions."""
    estimator, readings, actions = linear_readings(np.array([0.6, 2.0]), 600, 4)
    stretches = [Stretch(readings, actions)]
    prior_mean = estimator.noise
    noise, _ = fit_noise(estimator, stretches, prior_mean, 10.0, 40)
    precision = np.linalg.inv(noise_covariance(estimator, stretches, prior_mean, 10.0))
    assert np.allclose(estimator.noise, noise, rtol=1e-12)
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = 0.05 * rng.standard_normal(noise.size)
        losses = []
        for step in (-1.0, 0.0, 1.0):
            losses.append(
                loss_of_noise(estimator, stretches, prior_mean, 10.0, noise + step * direction)[0]
            )
        curvature = losses[0] - 2 * losses[1] + losses[2]
        assert curvature == pytest.approx(direction @ precision @ direction, rel=0.02)


def test_stretches_are_independent_data():
    """Theory: the log-likelihood of two stretches is the sum of theirs."""
    estimator, readings, actions = linear_readings(np.array([0.6, 2.0]), 100, 4)
    mean_of_prior = estimator.noise
    halves = [Stretch(readings[:50], actions[:50]), Stretch(readings[50:], actions[50:])]
    losses = []
    for stretches in (halves, halves[:1], halves[1:]):
        losses.append(loss_of_noise(estimator, stretches, mean_of_prior, 1.0, mean_of_prior)[0])
    assert losses[0] == pytest.approx(losses[1] + losses[2], rel=1e-12)


def test_separate_chances_add_up(rng):
    """Theory: variances of independent means are added."""
    costs = rng.normal(5.0, 1.0, (1, 400)).repeat(4, axis=0)
    others = rng.normal(3.0, 2.0, (1, 1600)).repeat(4, axis=0)
    estimate, share = difference_of_separate(costs, others, (16,))
    assert share == 0.0
    assert estimate.value == pytest.approx(costs.mean() - others.mean())
    variances = []
    for values in (costs[0], others[0]):
        means = values.reshape(16, -1).mean(axis=1)
        variances.append(means.var(ddof=1) / 16)
    half_width = (estimate.interval[1] - estimate.interval[0]) / 2
    # Student's quantile lies between that of 15 degrees of freedom and the normal one.
    assert 1.96 < half_width / sum(variances) ** 0.5 < 2.14


def test_a_log_is_followed_as_the_filter_does_it(assay, log):
    estimator = ExtendedKalmanFilter.from_scenario(assay)
    stretch = Stretch(log.readings[:40], log.actions[:40])
    followed = follow(estimator, [stretch, stretch])
    assert len(followed.means) == 80
    # Each stretch begins anew.
    for part in followed:
        assert np.array_equal(part[:40], part[40:], equal_nan=True)
    arrived = ~np.isnan(log.readings[:40])
    assert np.array_equal(~np.isnan(followed.innovations[:40]), arrived)


@pytest.mark.slow
def test_a_spike_of_a_reading_is_left_out(assay, log):
    readings = log.readings.copy()
    readings[700, 1] += 30.0
    answer = train_from_data(
        "model-based",
        replace(log, readings=readings),
        assay,
        start="cautious",
        settings=QUICK,
        log_settings={"drawn_models": 2},
    )
    assert answer.data.left_out == {"P2 jumps there and back": 1}
    assert np.isnan(answer.data.readings[700, 1])


def exchanged(table):
    return table[:, ::-1].copy()


REFUSED = {
    "inputs": (
        lambda log: replace(log, actions=exchanged(log.actions)),
        "columns P100 and F200 are exchanged|off the model's for good",
    ),
    "readings": (
        lambda log: replace(log, readings=log.readings + np.array([0.0, 6.0])),
        "readings of X2 are off the model's for good",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_log_that_is_misread_is_refused(assay, log, case):
    spoil, message = REFUSED[case]
    with pytest.raises(LoggedDataError, match=message):
        train_from_data("model-based", spoil(log), assay, start="cautious", settings=QUICK)


def test_a_log_of_readings_needs_sensors(log):
    with pytest.raises(ConfigurationError, match="'paper' has no sensors"):
        train_from_data("model-based", log, "paper")


@pytest.mark.slow
def test_what_is_predicted_of_a_log_is_true(assay, log):
    answer = train_from_data("model-based", log, assay, start="cautious", settings=QUICK)
    # The start was in charge: the plant's own answer is zero.
    low, high = answer.start_against_logged.interval
    assert low < 0.0 < high
    costs = []
    with FmuPlant(assay) as plant:
        for theta in (answer.learned, answer.start):
            law = build_controller("cautious", assay)
            law.parameters = theta
            costs.append(indicators_of(plant, law, range(5, 13), 1500)["J"])
    true_low, true_high = mean(costs[0] - costs[1]).interval
    low, high = answer.against_start.interval
    assert low < true_high
    assert true_low < high
    # Of the two readings one comes at each sample, and the other without noise.
    known = {parameter.name: parameter for parameter in answer.known.parameters}
    assert known["noise of sensor P2"].shown > 0.9
    assert abs(known["noise of sensor P2"].change) < 4 * known["noise of sensor P2"].deviation
    assert json.loads(json.dumps(answer.summary()))["verdict"] == answer.verdict


@pytest.mark.slow
def test_a_model_without_doubt_is_fitted_by_its_noises_alone(assay, log):
    certain = assay.replace({"estimator": {"parameter_drift": 0.0}})
    answer = train_from_data(
        "model-based",
        log,
        certain,
        start="cautious",
        settings=QUICK,
        log_settings={"drawn_models": 2},
    )
    assert all(one.name.startswith("noise of") for one in answer.known.parameters)
    assert np.isfinite(answer.learned_cost)


@pytest.mark.parametrize(("persistence", "warns"), [(0.0, False), (0.6, True)])
def test_innovations_that_follow_one_another_are_told(assay, rng, recwarn, persistence, warns):
    innovations = rng.standard_normal((600, 2))
    for k in range(1, 600):
        innovations[k, 1] += persistence * innovations[k - 1, 1]
    rule = SimpleNamespace(scenario=assay)
    _warn_of_persistence(rule, innovations, LogConfiguration())
    told = [str(warning.message) for warning in recwarn]
    assert bool(told) == warns
    assert all("in predicting P2 follow one another" in message for message in told)


def test_a_noise_that_the_fit_may_not_make_larger_is_told(assay):
    estimator = ExtendedKalmanFilter.from_scenario(assay)
    prior = SimpleNamespace(noise_prior=0.5)
    rule = SimpleNamespace(filter=estimator, prior_mean=estimator.noise, configuration=prior)
    noise = estimator.noise
    # Smaller than may be is no harm: the prior's own deviation is then too large.
    noise[0] -= 2.0
    noise[1] += 2.0
    with pytest.warns(
        ModelWarning, match="of disturbance F1 of 2.7 times what is expected"
    ) as all_:
        _warn_of_noise(rule, noise)
    assert len(all_) == 1
