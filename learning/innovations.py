"""The variances of an estimator's noises from a plant's readings, in prediction-error form.

The innovations of a filter with the right variances are white, of the variance that the filter
expects. The variances η (their logarithms) of greatest posterior density are taken: the likelihood
of all innovations, and a normal prior about what the scenario says. Readings may be late and far
apart: the filter needs no complete state at any sample.

Source: Ljung, System Identification, 1999, ch. 7 and 10; Gupta and Mehra, IEEE TAC 19(6), 1974.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from controllers.estimator import ExtendedKalmanFilter
from cosim.core.protocols import Array, Vector

REACH = 4.0
"""Deviations of the prior within which variances are fitted: a filter beyond them overflows."""


class Stretch(NamedTuple):
    """M samples of a plant, one after the other.

    Attributes:
        readings: y_k, NaN where there is none, (M, n_y).
        actions: u_k, (M, m).
    """

    readings: Array
    actions: Array


def replay(
    estimator: ExtendedKalmanFilter,
    stretch: Stretch,
) -> Array:
    """Run a filter over data; it ends at the last sample, after its correction.

    Args:
        estimator: the filter, reset here.
        stretch: the data.

    Returns:
        Innovations over their expected deviations, (M, n_y), NaN where there is no reading.
    """
    readings, actions = stretch
    standardised = np.empty_like(readings)
    estimator.reset()
    for k, y in enumerate(readings):
        # The reset filter stands before the first reading already.
        if k > 0:
            estimator.predict(actions[k - 1])
        estimator.correct(y)
        standardised[k] = estimator.standardised
    return standardised


def loss_of_noise(
    estimator: ExtendedKalmanFilter,
    stretches: Sequence[Stretch],
    prior_mean: Vector,
    prior_width: float,
    noise: Vector,
) -> tuple[float, Vector]:
    """Less the logarithm of the posterior density of η, but for a constant, and its gradient (q,).

    Args:
        estimator: a filter that differentiates; it has η afterwards.
        stretches: the data; the filter begins each anew.
        prior_mean: of η, (q,).
        prior_width: standard deviation of the prior.
        noise: η, (q,).
    """
    sensitivities = estimator.sensitivities
    assert sensitivities is not None
    estimator.noise = noise
    away = (noise - prior_mean) / prior_width
    value = float(away @ away) / 2
    gradient = away / prior_width
    for stretch in stretches:
        replay(estimator, stretch)
        value -= estimator.log_likelihood
        gradient = gradient - sensitivities.log_likelihood
    return value, gradient


def fit_noise(
    estimator: ExtendedKalmanFilter,
    stretches: Sequence[Stretch],
    prior_mean: Vector,
    prior_width: float,
    rounds: int,
) -> tuple[Vector, Array]:
    """The η of greatest posterior density, from the estimator's present η on.

    Args:
        estimator: a filter that differentiates; it has the result, after the last sample.
        stretches: the data; the filter begins each anew.
        prior_mean: of η, (q,).
        prior_width: standard deviation of the prior.
        rounds: of the quasi-Newton method at most.

    Returns:
        η, (q,), and with it the innovations of all stretches over their expected deviations,
        (M, n_y).
    """
    from scipy.optimize import Bounds, minimize  # noqa: PLC0415 - half a second

    # A θ file may be from far away.
    least = prior_mean - REACH * prior_width
    most = prior_mean + REACH * prior_width
    start = np.clip(estimator.noise, least, most)
    # The method may end at a point that is worse than its start, where a line search has failed.
    best: Vector = start
    least_loss = np.inf

    def loss(noise: Vector) -> tuple[float, Vector]:
        nonlocal best, least_loss
        value, gradient = loss_of_noise(estimator, stretches, prior_mean, prior_width, noise)
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
    standardised = [replay(estimator, stretch) for stretch in stretches]
    return best, np.vstack(standardised)


def noise_covariance(
    estimator: ExtendedKalmanFilter,
    stretches: Sequence[Stretch],
    prior_mean: Vector,
    prior_width: float,
    step: float = 0.05,
) -> Array:
    """Covariance of η after the data, (q, q), by the curvature of its posterior (Laplace).

    Args:
        estimator: a filter that differentiates, at the η that `fit_noise` found; it keeps that.
        stretches: the data.
        prior_mean: of η, (q,).
        prior_width: standard deviation of the prior.
        step: of η in the differences of the gradient.
    """
    noise = estimator.noise
    curvature = np.empty((noise.size, noise.size))
    for i in range(noise.size):
        gradients = []
        for sign in (-1.0, 1.0):
            moved = noise.copy()
            moved[i] += sign * step
            gradients.append(loss_of_noise(estimator, stretches, prior_mean, prior_width, moved)[1])
        curvature[i] = (gradients[1] - gradients[0]) / (2 * step)
    estimator.noise = noise
    eigenvalues, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    # Data never leave η less certain than it was, whatever the curvature at one point.
    precision = np.maximum(eigenvalues, 1 / prior_width**2)
    covariance: Array = (vectors / precision) @ vectors.T
    return covariance
