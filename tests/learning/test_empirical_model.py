"""The empirical model of a plant whose errors are known."""

import numpy as np
import pytest

from controllers import Problem
from cosim import Scenario
from learning.empirical_model import Features
from tests.helpers.empirical import fit, plant_data


def test_the_fit_predicts_a_plant_with_another_parameter(features, rng):
    error = rng.normal(scale=0.1, size=features.n_parameters)
    model = fit(features, *plant_data(features, rng, 4000, error))
    inputs, outputs = plant_data(features, rng, 4000, error)
    nominal, _, h = features(inputs, np.zeros(features.n_parameters))
    c, W = model.coefficients
    predicted = features(inputs, c)[0] + np.column_stack([np.ones(4000), inputs]) @ W.T
    wrong = np.abs((predicted - features(inputs, error)[0]) / h)
    assert wrong.max() < 0.03
    assert np.abs((nominal - outputs) / h).mean() > 5 * wrong.mean()
    assert np.allclose(model.residuals.std(axis=0), 0.1 / np.sqrt(3), rtol=0.05)


def test_what_the_nominal_model_knows_exactly_says_nothing_of_its_parameters(features, rng):
    inputs, outputs = plant_data(features, rng, 400, np.zeros(features.n_parameters))
    exact = features(inputs, np.zeros(features.n_parameters))[0][:, -1]
    outputs[:, -1] = exact * (1 + 1e-9 * rng.normal(size=400))
    model = fit(features, inputs, outputs)
    assert np.abs(model.coefficients[0]).max() < 0.1


def test_exact_outputs_do_not_drown_what_noisy_ones_say(rng):
    problem = Problem.from_scenario(Scenario.load("tanks"))
    features = Features(problem)
    reference = np.concatenate([problem.reference_state, problem.reference_action])
    inputs = reference * rng.uniform(0.9, 1.1, (480, 6))
    y, _, _ = features(inputs, rng.normal(scale=0.05, size=features.n_parameters))
    model = fit(features, inputs, y + rng.normal(size=y.shape) * [0.3, 0.3, 0, 0, 0])
    assert np.abs((model.predict(inputs)[0] - y).mean(axis=0)).max() < 0.05


@pytest.mark.slow
def test_the_deviation_of_the_mean_cost_is_what_the_fits_scatter(features, rng):
    at = plant_data(features, rng, 50, np.zeros(features.n_parameters))[0]
    costs, deviations = [], []
    for _ in range(12):
        error = rng.normal(scale=0.15, size=features.n_parameters).clip(-0.4, 0.4)
        model = fit(features, *plant_data(features, rng, 200, error))
        row, true = model.cost_derivative(at), features(at, error)[0]
        costs.append((model.predict(at)[0] - true)[:, -1].mean())
        deviations.append(np.sqrt(row @ model.covariance @ row))
    assert 0.4 < np.std(costs) / np.mean(deviations) < 1.6


def test_an_error_that_no_parameter_makes_is_fitted_too(features, rng):
    inputs, outputs = plant_data(features, rng, 8000, np.zeros(features.n_parameters))
    outputs[:, 0] += 0.2 * (inputs[:, 0] - 27.0) - 0.02 * (inputs[:, 2] - 220.0)
    model = fit(features, inputs[:4000], outputs[:4000])
    predicted, h, _ = model.predict(inputs[4000:])
    zero = np.zeros(features.n_parameters)
    beyond = (outputs - features(inputs, zero)[0])[:4000, :-1].mean(axis=0)
    error = model.nominal_prediction_error(inputs[:4000], zero)
    assert error == pytest.approx(beyond, rel=0.05, abs=0.01)
    assert np.allclose(((outputs[4000:] - predicted) / h).std(axis=0), 0.1 / np.sqrt(3), rtol=0.05)
