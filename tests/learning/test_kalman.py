import numpy as np
import pytest

from learning.q_learning import KalmanRegression


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
    fit = kalman.fit()
    assert fit.metric() == pytest.approx(information)
    assert fit.metric() @ fit.minimiser == pytest.approx(fit.gradient)


def test_an_entry_that_the_data_say_nothing_of_stays_at_its_prior(data):
    gradient, errors = data
    gradient[:, 3] = 0.0
    kalman = regression(4, 0.7)
    for row, error in zip(gradient, errors, strict=True):
        kalman.update(error, row)
    assert kalman.mean[3] == 0.0 and kalman.covariance[3, 3] == 1.0


def test_an_outlier_moves_no_further_than_the_clip():
    far, clipped = regression(1, 4.0), regression(1, 4.0, clip=3.0)
    far.update(6.0, np.ones(1))
    clipped.update(1e9, np.ones(1))
    assert clipped.mean == pytest.approx(far.mean)


def test_the_variance_follows_the_innovations(rng):
    kalman = regression(1, 100.0, memory=500.0)
    for error in 2.0 * rng.normal(size=20_000):
        kalman.update(error, np.zeros(1))
    assert kalman.variance == pytest.approx(4.0, rel=0.2)


def test_drift_lets_a_parameter_be_followed(rng):
    still, following = regression(1, 0.1), regression(1, 0.1, drift=1e-3)
    for k in range(4000):
        truth = 1.0 if k < 2000 else -1.0
        for kalman in (still, following):
            kalman.update(truth + 0.1 * rng.normal(), np.ones(1))
    assert following.mean[0] == pytest.approx(-1.0, abs=0.1)
    assert abs(still.mean[0]) < 0.2


def test_state_and_restore_carry_all(data):
    gradient, errors = data
    whole, resumed = regression(4, 0.7), regression(4, 1.0)
    for k, (row, error) in enumerate(zip(gradient, errors, strict=True)):
        if k == 30:
            resumed.restore(whole.state())
        whole.update(error, row)
        if k >= 30:
            resumed.update(error, row)
    assert np.array_equal(whole.mean, resumed.mean)
    assert np.array_equal(whole.covariance, resumed.covariance)
