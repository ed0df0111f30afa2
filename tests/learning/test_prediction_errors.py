import numpy as np
import pytest

from controllers.model import discretise
from controllers.theta import Parameters, ThetaBlocks
from cosim.core.scenario import Penalty
from learning.prediction_errors import (
    OneStepModel,
    PredictionErrors,
    SortedErrors,
    expected_penalties,
    known_penalty,
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
