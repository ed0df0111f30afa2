"""Controllers by name, for real scenarios."""

import numpy as np
import pytest

from controllers.factories import naive


def changed(scenario, **settings):
    controller = scenario.controller.model_copy(update=settings)
    return scenario.model_copy(update={"controller": controller})


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
