"""Offset-free control and back-off by prediction errors, from transitions made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from learning.algorithm import Transition, load_algorithm
from learning.prediction_errors import OneStepModel

MEMORY = 40


@pytest.fixture(scope="module")
def predict(scenario, problem):
    model, nominal = OneStepModel(scenario), problem.model.nominal_parameters
    return lambda s, a: model.predict(s, a, nominal)[0]


@pytest.fixture
def fed(scenario, problem, parameters, predict):
    """Give θ, (update by update), of offset-free control that meets given prediction errors."""

    def feed(errors, start=parameters, **settings):
        cls = load_algorithm("offset-free")
        settings = {"memory": MEMORY, "update_every": 1, **settings}
        controller = SimpleNamespace(parameters=start, theta=start.theta)
        rule = cls(
            controller,
            scenario,
            cls.Configuration.from_dict(settings),
            len(errors),
            None,
            np.random.default_rng(0),
        )
        s, a, seen = problem.reference_state, problem.reference_action, []
        expected = predict(s, a)
        for number, error in enumerate(errors):
            rule.observe(
                Transition(
                    number=number,
                    s=s,
                    a=a,
                    explored=False,
                    policy=None,
                    action_value=None,
                    stage_cost=1.0,
                    cost=1.0,
                    next_s=expected + error,
                    next_penalty=0.0,
                    next_policy=None,
                    point=None,
                    next_point=None,
                )
            )
            seen.append(start.with_theta(np.array(rule.theta)))
        return seen

    return feed


def test_the_offset_is_a_running_mean_at_first_and_forgets_exponentially_from_then_on(fed):
    """c ← c + (e − c)/min(k, memory): after a step of d it is d (1 − (1 − 1/memory)ᴷ) of it."""
    d, later = np.array([0.4, -0.6]), 60
    errors = np.concatenate([np.zeros((3 * MEMORY, 2)), np.tile(d, (later, 1))])
    offset = fed(errors)[-1]["c_f"]
    assert offset == pytest.approx(d * (1 - (1 - 1 / MEMORY) ** later))


def test_of_fewer_errors_than_the_memory_the_offset_is_their_mean(fed, rng):
    errors = rng.normal(0.0, 0.3, (MEMORY - 1, 2))
    for k, theta in enumerate(fed(errors), start=1):
        assert theta["c_f"] == pytest.approx(errors[:k].mean(axis=0))


def test_a_bound_stands_back_by_the_error_that_would_have_led_beyond_it(fed, scenario):
    """Lower bounds rise by the most negative error about the offset, upper ones fall."""
    errors = np.zeros((MEMORY, 2))
    errors[3], errors[7], errors[20], errors[21] = [-0.7, 0.0], [0.5, 0.0], [0.0, -1.0], [0.0, 2.0]
    theta = fed(errors)[-1]
    offset = errors.mean(axis=0)
    assert theta["x_l"] - scenario.state_lower == pytest.approx([0.7 + offset[0], 1.0 + offset[1]])
    assert scenario.state_upper - theta["x_u"] == pytest.approx([0.5 - offset[0], 2.0 - offset[1]])


def test_the_back_off_forgets_the_errors_that_its_memory_has_lost(fed, scenario):
    errors = np.zeros((3 * MEMORY, 2))
    errors[:10, 0] = -0.7
    theta = fed(errors)[-1]
    assert theta["x_l"][0] - scenario.state_lower[0] < 0.2


def test_with_few_errors_the_starts_back_off_is_kept(fed, scenario, parameters):
    start = parameters.replace({"x_l": parameters["x_l"] + [1.5, 0.0]})
    few = fed(np.zeros((MEMORY - 1, 2)), start)[-1]
    assert few["x_l"][0] - scenario.state_lower[0] == pytest.approx(1.5)
    enough = fed(np.zeros((MEMORY, 2)), start)[-1]
    assert enough["x_l"][0] == pytest.approx(scenario.state_lower[0])


def test_without_back_off_only_the_offset_moves(fed, parameters):
    theta = fed(np.full((MEMORY, 2), 0.3), back_off=False)[-1]
    moved = {
        name
        for name in ("c_f", "x_l", "x_u", "B_l", "b_l", "B_Vf", "b_Vf", "c_lambda")
        if not np.array_equal(theta[name], parameters[name])
    }
    assert moved == {"c_f"}
