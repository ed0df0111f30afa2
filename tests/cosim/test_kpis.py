import numpy as np
import pytest

from cosim import FmuPlant, Scenario, simulate
from cosim.kpis import displaced, indicators, input_effort, settling_time
from cosim.plugins import build_controller
from cosim.signals import signal_names
from cosim.trajectory import Signal, Trajectory
from tests.helpers.loop import Hold, Proportional


def run_with_states(scenario, time, states):
    columns = {name: np.zeros(len(time)) for name in signal_names(scenario)}
    columns["time"] = time
    columns |= dict(zip(scenario.plant.states, states.T, strict=True))
    signals = {name: Signal(name, "", values) for name, values in columns.items()}
    return Trajectory(scenario, signals, ["solved"] * len(time))


def test_input_effort_is_the_share_of_the_range_moved_per_sample():
    actions = np.array([[100.0, 200.0], [130.0, 200.0], [130.0, 170.0]])
    effort = input_effort(actions, np.array([100.0, 100.0]), np.array([400.0, 400.0]))
    assert effort == pytest.approx((0.1 + 0.1) / 2)


def test_a_first_order_lag_settles_into_five_per_cent_after_three_time_constants(paper):
    time = np.arange(2000) * 1.0
    states = np.exp(-time / 50.0)[:, None] * np.array([2.0, -3.0]) + np.array([25.0, 50.0])
    assert settling_time(run_with_states(paper, time, states)) == pytest.approx(
        50.0 * np.log(20.0), abs=1.0
    )


def test_a_state_that_still_drifts_has_not_settled(paper):
    time = np.arange(100) * 1.0
    states = np.stack([np.exp(-time / 5.0), 1.0 - time / 100.0], axis=1)
    assert np.isnan(settling_time(run_with_states(paper, time, states)))


def test_a_state_that_never_moves_has_settled_from_the_start(paper):
    time = np.arange(100) * 1.0
    moving = np.exp(-time / 5.0)
    constant = np.full(100, 0.1 + 0.2)
    states = np.stack([moving, constant], axis=1)
    assert settling_time(run_with_states(paper, time, states)) == pytest.approx(15.0, abs=1.0)
    states = np.stack([constant, constant], axis=1)
    assert settling_time(run_with_states(paper, time, states)) == 0.0


def test_the_displaced_plant_starts_off_the_operating_point_and_is_not_disturbed(paper):
    away = displaced(paper)
    np.testing.assert_allclose(away.initial_state, 1.1 * paper.reference_state)
    with FmuPlant(away) as plant:
        run = simulate(plant, Hold(paper.reference_action), 5, 0)
    np.testing.assert_array_equal(run.disturbances, np.tile([5.0, 10.0, 40.0, 25.0], (5, 1)))


def test_indicators_are_the_definitions_applied_to_the_signals(paper):
    with FmuPlant(paper) as plant:
        run = simulate(plant, Proportional(paper), 200, 3)
    found = indicators(run)
    violation = np.maximum(paper.state_lower - run.states, 0) + np.maximum(
        run.states - paper.state_upper, 0
    )
    penalty = (1e5 * violation + violation**2).sum(axis=1)
    assert found["mean_violation"] == pytest.approx(violation.sum(axis=1).mean(), rel=1e-12)
    assert found["violating_share"] == np.mean(violation.sum(axis=1) > 1e-6)
    assert found["J"] == pytest.approx(np.mean(run["stage_cost"] + penalty), rel=1e-12)
    assert found["economic_cost"] == pytest.approx(np.mean(run["stage_cost"]), rel=1e-12)
    assert found["failures"] == 0


def test_rounding_at_a_bound_is_no_violation_but_a_millionth_is(paper):
    below = np.array([0.0, 1e-14, 1e-9, 9e-7, 1.1e-6, 1e-3])
    run = run_with_states(paper, np.arange(6.0), np.stack([25.0 - below, np.full(6, 50.0)], axis=1))
    run.signals["violation"].values[:] = below
    found = indicators(run)
    assert found["violating_share"] == 2 / 6
    assert found["mean_violation"] == pytest.approx(below.mean(), rel=1e-12)


def test_a_controller_that_rests_on_its_bound_does_not_violate_it():
    nominal = Scenario.load("nominal")
    with FmuPlant(nominal) as plant:
        run = simulate(plant, build_controller("tuned", nominal), 300, 0)
    assert np.mean(run["violation"] > 0) > 0.2, "rounds nowhere below the bound: proves nothing"
    assert indicators(run)["violating_share"] == 0.0
