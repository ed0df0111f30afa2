"""What is large and small of a problem, against its steady state's multipliers and by hand."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from controllers.economic import optimal_steady_state
from controllers.errors import ModelError
from controllers.problem import Problem, load_model, multipliers
from controllers.theta import ThetaBlocks
from cosim.core.scenario import Scenario
from tests.helpers import linear_plant
from tests.helpers.other_zeros import COUNTINGS
from tests.helpers.sampling import evaporator_problem

BAD = {
    "short bound": {"state_lower": [25]},
    "bound not finite": {"action_upper": [400, np.inf]},
    "text": {"reference_action": "u_s"},
    "crossed states": {"state_lower": [25, 80]},
    "no linear penalty": {"penalty_linear": [0, 1]},
    "no horizon": {"horizon": 0},
    "discount above one": {"discount": 1.01},
    "no steps": {"substeps": 0},
    "no cost": {"reference_cost": np.nan},
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_value_has_one_clear_error(case):
    with pytest.raises(ModelError):
        evaporator_problem(**BAD[case])


@pytest.mark.parametrize(
    "name",
    [
        "controllers.nowhere:model",
        "controllers.evaporator:nothing",
        "controllers.evaporator",
        "",
        "controllers.evaporator:STATES",
        "builtins:dict",
    ],
)
def test_a_model_that_cannot_be_had_is_refused(name):
    with pytest.raises(ModelError):
        load_model(name)


PRESETS = ("paper", "fast-sampling", "fouled", "mismatched", "drifting", "nominal")


@pytest.mark.parametrize("preset", PRESETS)
def test_the_evaporators_units_are_the_numbers_that_the_stored_results_were_learnt_with(preset):
    units = Problem.from_scenario(Scenario.load(preset)).units
    assert units.state.tolist() == [100.0, 100.0] and units.action.tolist() == [100.0, 100.0]
    assert units.cost == 1e4
    assert units.exact_penalty_weights().tolist() == [61.0, 61.0]


def test_the_largest_multiplier_is_the_optimal_steady_states(problem):
    by_ipopt = optimal_steady_state(problem).multipliers[:2] * problem.units.state
    assert problem.units.largest_multiplier == pytest.approx(by_ipopt.max())


def test_other_decimal_units_and_zeros_change_the_units_alone():
    counting = COUNTINGS["paper"]
    state, action = np.array(counting.states[0]), np.array(counting.actions[0])
    own, other = (problem.units for problem in counting.problems(Scenario.load("paper")))
    assert other.state == pytest.approx(state * own.state, rel=1e-14)
    assert other.action == pytest.approx(action * own.action, rel=1e-14)
    assert other.cost == pytest.approx(counting.cost * own.cost, rel=1e-14)
    assert other.exact_penalty_weights() == pytest.approx(
        counting.cost / state * own.exact_penalty_weights(), rel=1e-14
    )


def test_the_scale_of_theta_is_recounted_with_the_problem():
    counting = COUNTINGS["paper"]
    own, other = (
        ThetaBlocks.from_problem(problem, slack_weights=True)
        for problem in counting.problems(Scenario.load("paper"))
    )
    assert other.scale == pytest.approx(counting.factors(own) * own.scale, rel=1e-13)


def test_a_constant_in_the_cost_changes_nothing(problem):
    own = problem.model
    dearer = dataclasses.replace(
        own, economic_cost=lambda x, u, d, p: own.economic_cost(x, u, d, p) + 1e6
    )
    moved = dataclasses.replace(problem, model=dearer, reference_cost=problem.reference_cost + 1e6)
    assert moved.units.cost == problem.units.cost


def test_without_an_active_bound_the_curvature_of_the_cost_counts():
    units = linear_plant.PLANE.problem.units
    # Bounds ±3 are of the order 10; ∂²ℓ/∂x₀² = 2, so 200 of cost over that.
    assert units.state.tolist() == [10.0, 10.0] and units.largest_multiplier == 0.0
    assert units.cost == 1e3
    assert (units.exact_penalty_weights() > 0).all()


def test_without_curvature_the_cost_itself_counts():
    problem = linear_plant.PLANE.problem
    flat = dataclasses.replace(problem.model, economic_cost=lambda x, u, d, p: 0.0 * x[0] + 7.0)
    flat_problem = dataclasses.replace(problem, model=flat, reference_cost=7.0)
    assert flat_problem.units.cost == 10.0
    assert dataclasses.replace(flat_problem, reference_cost=0.0).units.cost == 1.0


@pytest.mark.parametrize("width", [1e-300, 1e300])
def test_bounds_however_near_or_far_have_units(width):
    problem = linear_plant.SCALAR.problem
    extreme = dataclasses.replace(
        problem, state_lower=np.array([0.0]), state_upper=np.array([width])
    )
    blocks = ThetaBlocks.from_problem(extreme, slack_weights=True)
    assert np.isfinite(blocks.scale).all() and (blocks.scale > 0).all()


def test_multipliers_are_those_of_bounded_least_squares():
    """SciPy's solver of min ‖∇ℓ + (∂x')ᵀλ − μ‖ with signs on μ is the independent one."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        n, m = int(rng.integers(1, 4)), int(rng.integers(1, 4))
        gradient, rates = rng.normal(size=n + m), rng.normal(size=(n, n + m))
        place = rng.permutation(n + m)
        below, above = place == 0, place == 1
        signs, active = np.where(below, -1.0, 1.0), np.flatnonzero(below | above)
        columns = np.hstack([rates.T, np.diag(signs)[:, active]])
        least = np.r_[np.full(n, -np.inf), np.zeros(active.size)]
        expected = np.zeros(n + m)
        expected[active] = lsq_linear(columns, -gradient, (least, np.inf), method="bvls").x[n:]
        residual = [
            columns @ np.r_[_costates(columns, n, gradient, mu[active]), mu[active]] + gradient
            for mu in (expected, multipliers(gradient, rates, below, above))
        ]
        assert np.linalg.norm(residual[1]) == pytest.approx(np.linalg.norm(residual[0]), abs=1e-9)


def _costates(columns, n, gradient, mu):
    """λ that belongs to given multipliers."""
    return np.linalg.lstsq(columns[:, :n], -gradient - columns[:, n:] @ mu)[0]
