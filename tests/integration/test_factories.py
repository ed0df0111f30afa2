"""Controllers by name, for real scenarios."""

import numpy as np
import pytest

from controllers import Parameters, Problem
from controllers.factories import naive
from cosim import Scenario


@pytest.fixture(scope="module")
def paper():
    return Scenario.load("paper")


def changed(scenario, **settings):
    controller = scenario.controller.model_copy(update=settings)
    return scenario.model_copy(update={"controller": controller})


def test_naive_has_the_papers_theta(paper):
    controller = naive(paper)
    expected = Parameters.naive(Problem.from_scenario(paper))
    np.testing.assert_array_equal(controller.theta, expected.theta)


def test_the_value_offset_is_the_scenarios(paper):
    level = naive(changed(paper, value_offset="discounted")).parameters["c_lambda"]
    assert level == pytest.approx(paper.controller.reference_cost / 0.01)
    assert naive(paper).parameters["c_lambda"] == paper.controller.reference_cost


def test_backend_and_hessian_are_the_scenarios(paper):
    s = paper.reference_state + np.array([0.5, 1.0])
    first = naive(changed(paper, backend="proxqp", hessian="exact"))
    assert first.feedback(s).value == pytest.approx(naive(paper).feedback(s).value, rel=1e-6)
    assert type(first._backend).__name__ == "QpsolversBackend"
    assert first.feedback(s).prepared.spectrum is not None


def test_the_scenario_says_how_many_qps_a_sample_has(paper):
    s = [27.0, 52.0]
    one, three = (naive(changed(paper, iterations=k)).feedback(s).value for k in (1, 3))
    assert one == naive(paper).feedback(s).value != three
