"""Steps of θ: fits against their programmes, definiteness and constraints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from qpsolvers import solve_qp

from controllers.theta import Parameters, ThetaBlocks
from learning.configuration import Configuration
from learning.step import (
    ConstrainedStep,
    Fit,
    clip_eigenvalues,
    definite,
    policy_gradient_fit,
    smallest_eigenvalue,
    td_fit,
    td_step,
)
from tests.helpers.training import Carrier

SIZE = 6


def programme(fit):
    """Minimiser of dᵀMd − 2bᵀd by a QP solver that knows nothing of closed forms."""
    return solve_qp(2 * fit.metric(), -2 * fit.gradient, solver="daqp")


def check(fit):
    assert fit.minimiser == pytest.approx(programme(fit), rel=1e-6, abs=1e-9)


@given(seed=st.integers(0, 10**6), step_size=st.floats(1e-4, 10.0), td_error=st.floats(-1e3, 1e3))
def test_td_fit_equals_its_quadratic_programme(seed, step_size, td_error):
    gradient = np.random.default_rng(seed).normal(size=SIZE)
    check(td_fit(td_error, gradient, step_size))


def test_td_fit_is_normalised_and_the_td_step_is_not(rng):
    gradient = rng.normal(size=SIZE)
    norm = gradient @ gradient
    assert td_fit(2.0, gradient, 1e6).minimiser == pytest.approx(2.0 * gradient / norm, rel=1e-5)
    assert td_step(2.0, gradient, 0.3).minimiser == pytest.approx(0.6 * gradient)
    check(td_step(2.0, gradient, 0.3))


def test_policy_gradient_fit_descends_and_equals_its_programme(rng):
    root = rng.normal(size=(SIZE, SIZE))
    metric = root @ root.T + np.eye(SIZE)
    gradient = rng.normal(size=SIZE)
    fit = policy_gradient_fit(gradient, 0.7, metric)
    check(fit)
    assert fit.minimiser @ gradient < 0


SMALLEST = 1e-2


@pytest.fixture(scope="module")
def blocks(problem):
    return ThetaBlocks.from_problem(problem)


def fit_towards(target, metric):
    return Fit(metric @ target, target, lambda: metric)


def random_fit(blocks, rng, size=5.0):
    root = rng.normal(size=(blocks.size, blocks.size))
    return fit_towards(size * rng.normal(size=blocks.size), root @ root.T + np.eye(blocks.size))


def projected_gradient(blocks, theta, fit, rounds=2000):
    """The constrained fit by Frobenius projections: slow, and nothing in common with Clarabel."""
    weight = 1.0 / blocks.scale
    for name in ("B_l", "B_Vf"):
        size = blocks.block(name).shape[0]
        rows, columns = np.triu_indices(size)
        weight[blocks.slices[name]] = np.where(rows == columns, 1.0, np.sqrt(2.0))
    # In y = weight · scale · d a block's norm is Frobenius's, so clipping is the projection.
    unit = weight * blocks.scale
    metric = fit.metric() / np.outer(unit, unit)
    gradient = fit.gradient / unit
    y = np.zeros(blocks.size)
    z, momentum = y.copy(), 1.0
    length = 1.0 / np.linalg.eigvalsh(metric)[-1]
    for _ in range(rounds):
        moved = theta + (z - length * (metric @ z - gradient)) / weight
        new = (clip_eigenvalues(blocks, moved, SMALLEST) - theta) * weight
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        z, y, momentum = new + (momentum - 1) / following * (new - y), new, following
    return theta + y / weight


def objective(blocks, theta, new, fit):
    d = (new - theta) / blocks.scale
    return d @ fit.metric() @ d - 2 * fit.gradient @ d


def test_every_step_is_definite_and_certified(blocks, parameters, rng):
    theta = parameters.theta
    for _ in range(30):
        new = definite(blocks, theta, random_fit(blocks, rng), SMALLEST)
        assert smallest_eigenvalue(blocks, new) >= SMALLEST * (1 - 1e-9)


def test_a_free_step_that_is_definite_is_taken_as_it_is(blocks, parameters, rng):
    fit = random_fit(blocks, rng, size=1e-3)
    carrier = Carrier(parameters)
    update = ConstrainedStep(carrier, Configuration()).apply(fit, 0.0)
    assert np.array_equal(carrier.theta, parameters.theta + blocks.scale * fit.minimiser)
    assert not update.corrected


def test_a_theta_of_another_shape_is_told(parameters):
    size = parameters.theta.size
    step = ConstrainedStep(Carrier(parameters), Configuration())
    with pytest.raises(ValueError, match=rf"θ has shape \({size - 1},\), needs \({size},\)"):
        step.move(parameters.theta[1:])


def test_lmi_step_equals_a_generic_conic_solution(blocks, parameters, rng):
    theta = parameters.theta
    for _ in range(3):
        root = rng.normal(size=(blocks.size, blocks.size)) / np.sqrt(blocks.size)
        metric = root @ root.T + 0.3 * np.eye(blocks.size)
        fit = fit_towards(2.0 * rng.normal(size=blocks.size), metric)
        new = definite(blocks, theta, fit, SMALLEST)
        reference = projected_gradient(blocks, theta, fit)
        assert objective(blocks, theta, new, fit) == pytest.approx(
            objective(blocks, theta, reference, fit), rel=1e-6
        )
        assert (new - reference) / blocks.scale == pytest.approx(0.0, abs=1e-4)


@pytest.fixture
def controller(problem):
    return Carrier(Parameters.naive(problem, ThetaBlocks.from_problem(problem, slack_weights=True)))


def towards(blocks, **values):
    d = np.zeros(blocks.size)
    for name, entries in values.items():
        d[blocks.slices[name]] = entries
    return Fit(d, d, lambda: np.eye(d.size))


def test_a_hessian_keeps_its_units_in_other_coordinates(controller):
    scale = np.linspace(0.1, 7.0, controller.theta.size)
    step = ConstrainedStep(controller, Configuration(), scale)
    update = step.apply(towards(step.blocks, c_lambda=1.0), td_error=1.0)
    parameters = controller.parameters
    assert update.smallest_eigenvalue == smallest_eigenvalue(parameters.blocks, parameters.theta)


def test_it_moves_theta_by_the_scaled_step(controller):
    step = ConstrainedStep(controller, Configuration())
    before = controller.theta.copy()
    update = step.apply(towards(step.blocks, c_lambda=2.0, x_l=[0.5, 0.0]), td_error=3.0)
    assert (
        controller.parameters["c_lambda"]
        == before[controller.parameters.blocks.slices["c_lambda"]] + 2e3
    )
    assert controller.parameters["x_l"].tolist() == [25.5, 40.0]
    assert update.td_error == 3.0 and update.step == pytest.approx(np.hypot(2.0, 0.5))
    assert not update.corrected and update.smallest_eigenvalue == pytest.approx(1.0)


def test_slack_weights_stay_above_what_exactness_asks_for(controller):
    step = ConstrainedStep(controller, Configuration())
    step.apply(towards(step.blocks, w_sigma=-1e6, W_sigma=-1e6), 0.0)
    assert controller.parameters["w_sigma"].tolist() == [61.0, 61.0]
    assert controller.parameters["W_sigma"].tolist() == [1.0, 1.0]


def test_bounds_that_would_cross_refuse_the_step(controller):
    step = ConstrainedStep(controller, Configuration())
    before = controller.theta.copy()
    update = step.apply(towards(step.blocks, x_l=[200.0, 0.0], b_l=1.0), 0.0)
    assert update.refused and update.step == 0.0
    assert np.array_equal(controller.theta, before)


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
        update = step.apply(fit.within(3.0, np.linalg.norm), 0.0)
        assert np.linalg.norm((controller.theta - before) / step.scale) <= 3.0 * (1 + 1e-9)
        assert update.smallest_eigenvalue >= least * (1 - 1e-9)
        corrected += update.corrected
    assert corrected > 20, "the test must meet corrected steps"


def test_a_flat_start_is_not_lifted(problem):
    flat = Carrier(Parameters.naive(problem).replace({"B_l": np.diag([1.0, 1.0, 1e-4, 1.0])}))
    step = ConstrainedStep(flat, Configuration())
    update = step.apply(towards(step.blocks, x_l=[0.1, 0.0]), 0.0)
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


def test_a_restored_step_keeps_the_least_eigenvalue_of_where_it_began(controller):
    """Half of that θ's own, where this is less than the configuration's."""
    small = Configuration(smallest_eigenvalue=10.0)
    step = ConstrainedStep(controller, small)
    parameters = controller.parameters
    controller.theta = parameters.replace({"B_l": 0.5 * parameters["B_l"]}).theta
    resumed = ConstrainedStep(controller, small)
    assert resumed._smallest != step._smallest
    resumed.load_state_dict(step.state_dict())
    assert resumed._smallest == step._smallest
