import numpy as np
import pytest

from cosim import FmuPlant, Scenario, simulate
from cosim.plugins import build_controller
from cosim.simulation import indicators, input_effort
from cosim.trajectory import Signal, Trajectory, signal_names
from tests.helpers.loop import Proportional


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
