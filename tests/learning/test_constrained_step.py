import numpy as np
import pytest

from controllers.theta import Parameters, ThetaBlocks
from learning.configuration import Configuration
from learning.errors import DivergenceError
from learning.step import ConstrainedStep, Fit, rescaled
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


def test_rescaled_coordinates_are_theta_itself(controller):
    step = ConstrainedStep(controller, Configuration(), scaled=False)
    step.take(towards(step.blocks, c_lambda=2.0), 0.0)
    assert controller.parameters["c_lambda"] == pytest.approx(6210.384509575885 + 2.0)
    blocks = controller.parameters.blocks
    assert rescaled(blocks, np.ones(blocks.size)).labels == blocks.labels


def test_a_trust_region_holds_after_the_lmi(controller, rng):
    """The corrected step stays within the cap, and B ⪰ εI with it."""
    step = ConstrainedStep(controller, Configuration())
    size, least = step.scale.size, Configuration().smallest_eigenvalue
    corrected = 0
    for _ in range(40):
        # Ill conditioned, as information is: what the free step leaves out is cheap to move.
        factor = rng.normal(size=(size, size)) * np.geomspace(1.0, 1e-4, size)
        metric = factor @ factor.T + 1e-8 * np.eye(size)
        minimiser = rng.normal(size=size) * 3.0
        fit = Fit(metric @ minimiser, minimiser, lambda metric=metric: metric)
        before = controller.theta.copy()
        new, vouched = step.proposal(fit.within(3.0, np.linalg.norm))
        assert np.linalg.norm((new - before) / step.scale) <= 3.0 * (1 + 1e-9)
        assert vouched.smallest >= least * (1 - 1e-9)
        corrected += vouched.corrected
        controller.theta = new
    assert corrected > 20, "the test must meet corrected steps"


def test_a_flat_start_is_not_lifted(problem):
    flat = Carrier(Parameters.naive(problem).replace({"B_l": np.diag([1.0, 1.0, 1e-4, 1.0])}))
    step = ConstrainedStep(flat, Configuration())
    update = step.take(towards(step.blocks, x_l=[0.1, 0.0]), 0.0)
    assert not update.corrected
    assert flat.parameters["B_l"][2, 2] == 1e-4


def test_a_projection_keeps_what_is_admissible_and_mends_the_rest(controller):
    step = ConstrainedStep(controller, Configuration())
    theta = controller.theta.copy()
    theta[step.blocks.slices["x_l"]] = [26.0, 41.0]
    assert not step.move(theta).corrected
    assert np.array_equal(controller.theta, theta)
    theta[step.blocks.slices["B_Vf"]] = [-1.0, 0.0, 2.0]
    assert step.move(theta).corrected
    assert controller.parameters["B_Vf"] == pytest.approx(np.diag([1e-3, 2.0]), abs=1e-5)
