import numpy as np
import pytest

from controllers.parameters import Parameters
from controllers.theta import ThetaBlocks
from learning.configuration import Configuration
from learning.constrained_step import ConstrainedStep, unscaled
from learning.errors import DivergenceError
from learning.fit import Fit
from tests.helpers.carrier import Carrier


@pytest.fixture
def controller(problem):
    return Carrier(Parameters.naive(problem, ThetaBlocks.of(problem, slack_weights=True)))


def towards(blocks, **values):
    d = np.zeros(blocks.size)
    for name, entries in values.items():
        d[blocks.slices[name]] = entries
    return Fit(d, d, lambda: np.eye(d.size))


def test_take_moves_theta_by_the_scaled_step(controller):
    step = ConstrainedStep(controller, Configuration())
    before = controller.theta.copy()
    update = step.take(towards(step.blocks, c_lambda=2.0, x_l=[0.5, 0.0]), td_error=3.0)
    assert (
        controller.parameters["c_lambda"]
        == before[controller.parameters.blocks.slices["c_lambda"]] + 2e3
    )
    assert controller.parameters["x_l"].tolist() == [25.5, 40.0]
    assert update.td_error == 3.0 and update.step == pytest.approx(np.hypot(2.0, 0.5))
    assert not update.corrected and update.smallest_eigenvalue == pytest.approx(1.0)


def test_slack_weights_stay_above_what_exactness_asks_for(controller):
    step = ConstrainedStep(controller, Configuration())
    step.take(towards(step.blocks, w_sigma=-1e6, W_sigma=-1e6), 0.0)
    assert controller.parameters["w_sigma"].tolist() == [61.0, 61.0]
    assert controller.parameters["W_sigma"].tolist() == [1.0, 1.0]


def test_bounds_that_would_cross_refuse_the_step(controller):
    step = ConstrainedStep(controller, Configuration())
    before = controller.theta.copy()
    update = step.take(towards(step.blocks, x_l=[200.0, 0.0], b_l=1.0), 0.0)
    assert update.refused and update.step == 0.0
    assert np.array_equal(controller.theta, before)


def test_a_step_that_is_not_finite_is_divergence(controller):
    step = ConstrainedStep(controller, Configuration())
    with pytest.raises(DivergenceError):
        step.take(towards(step.blocks, b_l=np.nan), 0.0)


def test_unscaled_coordinates_are_theta_itself(controller):
    step = ConstrainedStep(controller, Configuration(), scaled=False)
    step.take(towards(step.blocks, c_lambda=2.0), 0.0)
    assert controller.parameters["c_lambda"] == pytest.approx(6210.384509575885 + 2.0)
    assert unscaled(controller.parameters.blocks).labels == controller.parameters.blocks.labels
