"""The empirical model's estimate and its alarm, against plain code of the same formulas."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg, stats

from controllers.model import discretise, economic_cost
from learning.empirical_model import Features
from learning.plant_data import PlantData
from tests.helpers.empirical import SETTINGS, fit
from tests.helpers.jacketed_tank import jacketed_tank

PARAMETERS = 0.15
"""Prior standard deviation of a parameter's relative error."""
SLOPES = (0.1, 0.01, 0.001)
"""Those of the slopes of W, in standard deviations of the error over one of the input."""
CENTRE, WIDTH = [27.0, 60.0, 220.0, 230.0], [2.0, 6.0, 20.0, 20.0]


def plant_data(features, rng, count, error):
    """Inputs about the steady state and outputs of a plant whose parameter errors are `error`."""
    inputs = rng.normal(CENTRE, WIDTH, (count, 4))
    y, _, h = features(inputs, error)
    return inputs, y + h * rng.normal(0.0, 0.1, y.shape)


class PlainEstimate:
    """c and W of one prior by generalised least squares, and what a Gaussian posterior has.

    min Σᵢ rᵢ' Σ⁻¹ rᵢ + β' Λ β with rᵢ = (Yᵢ − y(xᵢ; c) − W (1, zᵢ)) / hᵢ by Gauss–Newton: a row
    of a least-squares problem for each output of each sample, and Σ from the residuals.
    """

    def __init__(self, features, inputs, outputs, slopes):
        z = (inputs - inputs.mean(axis=0)) / inputs.std(axis=0)
        z = np.column_stack([np.ones(len(z)), z])
        p, K = features.n_parameters, features.n_outputs
        deviation = (outputs - features(inputs, np.zeros(p))[0]).std(axis=0)
        widths = [[own] + [own * slopes] * inputs.shape[1] for own in deviation]
        prior = np.concatenate([np.full(p, PARAMETERS), np.ravel(widths)])
        beta, self.noise = np.zeros(len(prior)), None
        for _ in range(5):
            y, G, h = features(inputs, beta[:p])
            W = beta[p:].reshape(K, -1)
            residuals = (outputs - y - z @ W.T) / h
            self.noise = residuals.T @ residuals / len(residuals)
            whitened = np.linalg.inv(np.linalg.cholesky(self.noise))
            rows, misfits = [], []
            for i in range(len(inputs)):
                design = np.hstack([G[i], np.kron(np.eye(K), z[i])]) / h[i][:, None]
                rows.append(whitened @ design)
                misfits.append(whitened @ residuals[i])
            A = np.vstack([*rows, np.diag(1 / prior)])
            wanted = np.concatenate([*misfits, -beta / prior])
            beta = beta + linalg.lstsq(A, wanted, lapack_driver="gelsy")[0]
        self.beta, self.covariance = beta, np.linalg.inv(A.T @ A)
        loss = (wanted**2).sum() / 2
        volume = np.linalg.slogdet(self.covariance)[1] / 2 - np.log(prior).sum()
        self.evidence = volume - loss - len(inputs) * np.linalg.slogdet(self.noise)[1] / 2


def test_the_estimate_is_that_of_plain_generalised_least_squares(features, rng):
    error = rng.normal(scale=0.05, size=features.n_parameters)
    inputs, outputs = plant_data(features, rng, 120, error)
    outputs[:, 0] += 0.02 * (inputs[:, 0] - 27.0)
    model = fit(features, inputs, outputs)
    plain = max(
        (PlainEstimate(features, inputs, outputs, slopes) for slopes in SLOPES),
        key=lambda estimate: estimate.evidence,
    )
    deviations = np.sqrt(np.diag(plain.covariance))
    assert np.abs((model.mean - plain.beta) / deviations).max() < 0.05
    assert np.sqrt(np.diag(model.covariance)) == pytest.approx(deviations, rel=0.02)
    # Not the deviations alone: of any combination of the coefficients the same.
    both = linalg.eigh(model.covariance, plain.covariance, eigvals_only=True)
    assert (both.min(), both.max()) == pytest.approx((1.0, 1.0), rel=0.05)
    assert model.noise == pytest.approx(plain.noise, rel=0.02, abs=2e-5)


def sample(inputs, outputs):
    return SimpleNamespace(
        s=inputs[:2], a=inputs[2:], next_s=outputs[:2], stage_cost=float(outputs[2]), number=0
    )


@pytest.mark.parametrize("count", [60, 400])
def test_a_change_is_seen_where_hotellings_p_says_so_with_the_models_own_uncertainty(
    features, rng, count
):
    """Fifteen new samples off where the model was fitted, with a mean error of known p.

    T² = ē' (Σ/15 + D C D')⁻¹ ē with the coefficients' covariance C: p = P(F(K, M−K) > …).
    """
    data = PlantData(features, SETTINGS)
    for row in zip(*plant_data(features, rng, count, np.zeros(features.n_parameters)), strict=True):
        data.add(sample(*row))
    model = data.fit()
    M, K = model.residuals.shape
    away = np.array(CENTRE) + 3.0 * np.array(WIDTH) + rng.normal(0.0, 0.1, (15, 4)) * WIDTH
    predicted, h, design = model.predict(away)
    mean_design = design.mean(axis=0)
    certain = model.noise / 15
    covariance = certain + mean_design @ model.covariance @ mean_design.T
    direction = np.array([1.0, -0.5, 0.3])

    def errors_of(p):
        """The constant error whose T² has this p."""
        t2 = stats.f.isf(p, K, M - K) * K * (M - 1) / (M - K)
        return direction * np.sqrt(t2 / (direction @ np.linalg.solve(covariance, direction)))

    t2 = errors_of(1e-6) @ np.linalg.solve(certain, errors_of(1e-6))
    blind = stats.f.sf(t2 * (M - K) / (K * (M - 1)), K, M - K)
    assert blind < 1e-8, "without the model's uncertainty the alarm would be raised"
    regime_start = data.count
    for row in zip(away, predicted + h * errors_of(1e-6), strict=True):
        data.add(sample(*row))
    predictions = data.predictions()
    assert not data.changed(predictions)
    assert data.changed(predictions, [15]), "where the samples are dearer too, 1e-4 is enough"
    assert data.regime_start == regime_start
    data.regime_start = 0
    more = errors_of(1e-8) - errors_of(1e-6)
    assert data.changed(predictions._replace(errors=predictions.errors + more))
    assert data.regime_start == regime_start


def test_there_is_no_false_alarm_where_a_plant_is_met_elsewhere_than_before(features):
    """Twenty fits to few samples of a plant that stays: each alarm has a probability of 1e-7."""
    rng, alarms = np.random.default_rng(5), 0
    for _ in range(20):
        error = rng.normal(scale=0.1, size=features.n_parameters)
        data = PlantData(features, SETTINGS)
        for row in zip(*plant_data(features, rng, 40, error), strict=True):
            data.add(sample(*row))
        data.fit()
        inputs = np.array(CENTRE) + np.array(WIDTH) * (rng.normal(0, 1, 4) * 2 + 0.3)
        inputs = inputs + rng.normal(0.0, 0.2, (60, 4)) * WIDTH
        y, _, h = features(inputs, error)
        for row in zip(inputs, y + h * rng.normal(0.0, 0.1, y.shape), strict=True):
            data.add(sample(*row))
        alarms += data.changed(data.predictions())
    assert alarms == 0


@pytest.mark.parametrize("samples", [120, 480])
def test_a_wrong_parameter_is_found_where_one_disturbance_moves_all_states(samples):
    """The errors of the wrong model persist in the closed loop; those of the plant are white."""
    problem = jacketed_tank()
    features = Features(problem)
    rng = np.random.default_rng(1)
    step = discretise(problem.model, problem.sampling_time, problem.substeps)
    cost = economic_cost(problem.model)
    parameters = np.array([0.0697, 1.2])
    s = np.array([61.0, 80.0])
    inputs, outputs = [], []
    for _ in range(samples):
        a = np.clip(30.0 + 60.0 * (61.0 - s[:1]), 0.0, 80.0)
        d = rng.uniform([5.0, 15.0], [11.0, 25.0])
        following = step(s, a, d, parameters).full().ravel()
        inputs.append([*s, *a])
        outputs.append([*following, cost(s, a, d, parameters).full().item()])
        s = following
    model = fit(features, np.array(inputs), np.array(outputs))
    assert not model.persistence.any()
    deviation = np.sqrt(model.covariance[1, 1])
    assert abs(model.mean[1] + 0.2) < 3.0 * deviation
    assert deviation < 0.003
