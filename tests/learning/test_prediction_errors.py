import numpy as np
import pytest

from controllers.model import discretise
from controllers.theta import Parameters, ThetaBlocks
from cosim.core.scenario import Penalty
from learning.prediction_errors import (
    OneStepModel,
    PredictionErrors,
    SortedErrors,
    effective_number,
    error_covariance,
    estimate_persistence,
    expected_penalties,
    known_penalty,
    mean_error_covariance,
)


def test_the_penalty_of_many_states_is_that_of_each(scenario, rng):
    states = np.array([32.0, 60.0]) + rng.normal(size=(50, 2)) * [10.0, 20.0]
    each = [scenario.state_penalty(list(s)) for s in states]
    assert known_penalty(scenario.state_penalty, states) == pytest.approx(each)


def test_the_expected_penalty_has_the_mean_of_the_realised_one_and_less_spread(scenario, rng):
    """Plant s₊ = f + e with uniform e, as the model has it: both estimate E[p(s₊) | s, a]."""
    penalty, errors = scenario.state_penalty, PredictionErrors(scenario, 4000)
    draws = rng.uniform(-2.0, 2.0, size=(4000, 2))
    for e in draws:
        errors.add(e)
    prediction = np.array([26.0, 60.0])
    exact = 1e5 * 1.0**2 / 2 / 4 + 1.0**3 / 3 / 4  # E[b v + B v²], v = max(-1 - e, 0)
    assert errors.expected_penalty(prediction) == pytest.approx(exact, rel=0.1)
    realised = known_penalty(penalty, prediction + rng.uniform(-2.0, 2.0, size=(4000, 2)))
    assert realised.mean() == pytest.approx(exact, rel=0.1)
    assert realised.std() > exact


def test_an_estimate_is_expected_to_cost_what_the_states_cost_that_it_may_be(scenario, rng):
    errors = PredictionErrors(scenario, 50)
    jumps = rng.normal(size=(50, 2))
    variances = rng.uniform(0.5, 2.0, size=(50, 2))
    for jump, of_estimate in zip(jumps, variances, strict=True):
        errors.add(jump, of_estimate)
    prediction = np.array([26.0, 60.0])
    noise = rng.normal(size=(20_000, 50, 2)) * np.sqrt(variances)
    states = prediction + jumps + noise
    by_draws = known_penalty(scenario.state_penalty, states).mean()
    assert errors.expected_penalty(prediction) == pytest.approx(by_draws, rel=0.01)
    other = PredictionErrors(scenario, 50)
    other.load_state_dict(errors.state_dict())
    assert other.expected_penalty(prediction) == errors.expected_penalty(prediction)


def test_the_oldest_errors_are_forgotten(scenario):
    errors = PredictionErrors(scenario, 3)
    assert np.isnan(errors.expected_penalty(np.array([25.0, 50.0])))
    for k in range(5):
        errors.add(np.array([float(k), 0.0]))
    assert sorted(errors.values[:, 0]) == [2.0, 3.0, 4.0]
    other = PredictionErrors(scenario, 3)
    other.load_state_dict(errors.state_dict())
    assert np.array_equal(other.values, errors.values)


def test_all_pairs_are_averaged_and_an_infinite_bound_costs_nothing(scenario, rng):
    penalty = scenario.state_penalty
    predictions = np.array([25.0, 80.0]) + rng.normal(size=(5, 2))
    errors, scales = rng.normal(size=(7, 2)), rng.uniform(0.5, 2.0, size=(5, 2))
    one_by_one = [
        penalty(f + h * e) for f, h in zip(predictions, scales, strict=True) for e in errors
    ]
    found = expected_penalties(penalty, predictions, SortedErrors(errors), scales)
    each = np.reshape(one_by_one, (5, 7)).mean(axis=1)
    assert found.sum(axis=(0, 1)) == pytest.approx(each)
    open_above = Penalty(penalty.lower, [np.inf, np.inf], penalty.linear, penalty.quadratic)
    found_open = expected_penalties(open_above, predictions, SortedErrors(errors), scales)
    assert not found_open[:, 1].any() and np.array_equal(found_open[:, 0], found[:, 0])


def test_errors_are_those_of_the_model_with_thetas_parameters_and_offset(scenario, problem, rng):
    blocks = ThetaBlocks.from_problem(problem, model_parameters=("UA2",))
    theta = Parameters.naive(problem, blocks).replace({"p": [5.2], "c_f": [0.1, -0.2]})
    model = problem.model
    f = discretise(model, problem.sampling_time, problem.substeps)
    p = model.nominal_parameters
    p[model.parameter_indices(("UA2",))] = 5.2
    states = problem.reference_state + rng.normal(size=(4, 2))
    actions = problem.reference_action + rng.normal(size=(4, 2))
    following = rng.normal(size=(4, 2))
    expected = [
        y - f(s, a, model.nominal_disturbance, p).full().reshape(-1) - [0.1, -0.2]
        for s, a, y in zip(states, actions, following, strict=True)
    ]
    found = OneStepModel(scenario).errors(states, actions, following, theta)
    assert found == pytest.approx(np.array(expected), abs=1e-12)


PHI = np.array([[0.7, 0.2], [-0.1, 0.5]])
SIGMA = np.array([[1.0, 0.3], [0.3, 0.5]])
NONE = np.zeros((2, 2))


def autoregression(rng, count, phi):
    """Consecutive errors r₊ = Φ r + e."""
    noise = rng.multivariate_normal(np.zeros(2), SIGMA, count)
    errors = np.zeros((count, 2))
    for k in range(1, count):
        errors[k] = phi @ errors[k - 1] + noise[k]
    return errors


def test_the_autoregression_is_found(rng):
    errors = autoregression(rng, 20_000, PHI)
    assert estimate_persistence(errors[1:], errors[:-1], NONE, 0, doubt=4.0) == pytest.approx(
        PHI, abs=0.03
    )


def test_independent_errors_do_not_persist(rng):
    errors = autoregression(rng, 500, NONE)
    assert not estimate_persistence(errors[1:], errors[:-1], NONE, 0, doubt=4.0).any()


def test_an_earlier_estimate_counts_like_errors_seen_here(rng):
    errors = autoregression(rng, 21, NONE)
    found = estimate_persistence(errors[1:], errors[:-1], PHI, 2000, doubt=4.0)
    assert found == pytest.approx(PHI, abs=0.02)


def test_one_disturbance_of_three_states_persists_as_it_does(rng):
    """All outputs err alike, but for a ten-millionth, which says nothing of the next errors."""
    (source,) = autoregression(rng, 2000, 0.5 * np.eye(2)).T[:1]
    errors = np.outer(source, [1.0, 2.0, -1.0])
    errors += 1e-7 * rng.standard_normal(errors.shape)
    phi = estimate_persistence(errors[1:], errors[:-1], np.zeros((3, 3)), 0, doubt=4.0)
    assert phi @ [1.0, 2.0, -1.0] == pytest.approx([0.5, 1.0, -0.5], abs=0.1)
    assert np.abs(phi).max() < 1.0


def test_the_covariance_solves_lyapunovs_equation():
    gamma = error_covariance(PHI, SIGMA)
    assert gamma == pytest.approx(PHI @ gamma @ PHI.T + SIGMA)


def test_an_output_with_hardly_any_noise_has_its_covariance_too():
    scale = np.diag([1.0, 1e-60])
    phi = scale @ PHI @ np.linalg.inv(scale)
    gamma = error_covariance(phi, scale @ SIGMA @ scale)
    expected = scale @ error_covariance(PHI, SIGMA) @ scale
    np.testing.assert_allclose(gamma, expected, rtol=1e-12)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_the_covariance_of_a_mean_is_the_sum_of_all_covariances(count):
    gamma = error_covariance(PHI, SIGMA)
    total = np.zeros((2, 2))
    for i in range(count):
        for j in range(count):
            power = np.linalg.matrix_power(PHI, abs(i - j))
            total += power @ gamma if i >= j else gamma @ power.T
    assert mean_error_covariance(PHI, SIGMA, count) == pytest.approx(total / count**2)


def test_the_effective_number_is_that_of_a_scalar_autoregression():
    gamma = error_covariance(np.array([[0.9]]), np.array([[1.0]]))
    variance = mean_error_covariance(np.array([[0.9]]), np.array([[1.0]]), 10_000)
    independent = float(gamma[0, 0] / variance[0, 0])
    assert effective_number(np.array([[0.9]]), 10_000) == pytest.approx(independent, rel=0.01)
    assert effective_number(NONE, 30) == 30
