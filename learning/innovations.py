"""The variances of an estimator's noises from a plant's readings, in prediction-error form.

The innovations of a filter with the right variances are white, of the variance that the filter
expects. The variances η (their logarithms) of greatest posterior density are taken: the likelihood
of all innovations, and a normal prior about what the scenario says. Readings may be late and far
apart: the filter needs no complete state at any sample.

Source: Ljung, System Identification, 1999, ch. 7 and 10; Gupta and Mehra, IEEE TAC 19(6), 1974.
"""

from __future__ import annotations

import numpy as np

from controllers.estimator import ExtendedKalmanFilter
from cosim.core.protocols import Array, Vector


def replay(
    estimator: ExtendedKalmanFilter,
    readings: Array,
    actions: Array,
) -> Array:
    """Run a filter over data; it ends at the last sample, after its correction.

    Args:
        estimator: the filter, reset here.
        readings: y_k, NaN where there is none, (M, n_y).
        actions: u_k, (M, m).

    Returns:
        Innovations over their expected deviations, (M, n_y), NaN where there is no reading.
    """
    standardised = np.empty_like(readings)
    estimator.reset()
    for k, y in enumerate(readings):
        # The reset filter stands before the first reading already.
        if k > 0:
            estimator.predict(actions[k - 1])
        estimator.correct(y)
        standardised[k] = estimator.standardised
    return standardised


def fit_noise(
    estimator: ExtendedKalmanFilter,
    readings: Array,
    actions: Array,
    prior_mean: Vector,
    prior_width: float,
    rounds: int,
) -> tuple[Vector, Array]:
    """The η of greatest posterior density, from the estimator's present η on.

    Args:
        estimator: a filter that differentiates; it has the result, after the last sample.
        readings: y_k, (M, n_y).
        actions: u_k, (M, m).
        prior_mean: of η, (q,).
        prior_width: standard deviation of the prior.
        rounds: of the quasi-Newton method at most.

    Returns:
        η, (q,), and with it the innovations over their expected deviations, (M, n_y).
    """
    from scipy.optimize import Bounds, minimize  # noqa: PLC0415 - half a second

    sensitivities = estimator.sensitivities
    assert sensitivities is not None

    # Four deviations of the prior: a filter beyond them overflows. A θ file may be from far away.
    least = prior_mean - 4.0 * prior_width
    most = prior_mean + 4.0 * prior_width
    start = np.clip(estimator.noise, least, most)
    # The method may end at a point that is worse than its start, where a line search has failed.
    best: Vector = start
    least_loss = np.inf

    def loss(noise: Vector) -> tuple[float, Vector]:
        nonlocal best, least_loss
        estimator.noise = noise
        replay(estimator, readings, actions)
        # Less the logarithm of the posterior density: of the prior, and of the likelihood.
        away = (noise - prior_mean) / prior_width
        of_prior = float(away @ away) / 2
        value = of_prior - estimator.log_likelihood
        gradient_of_prior = away / prior_width
        gradient = gradient_of_prior - sensitivities.log_likelihood
        if value < least_loss:
            least_loss = value
            best = noise.copy()
        return value, gradient

    with np.errstate(over="ignore", invalid="ignore"):  # of a filter that runs away
        minimize(
            loss,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=Bounds(least, most),
            options={"maxiter": rounds, "maxfun": 2 * rounds},
        )
        # The present η may be far from what the data say: the prior's mean is tried as well.
        loss(prior_mean)
    # The last point that was tried need not be the best one: once more with that.
    estimator.noise = best
    standardised = replay(estimator, readings, actions)
    return best, standardised
