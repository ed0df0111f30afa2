"""A controller in the shadow of a log: of its own log it repeats each action."""

from types import SimpleNamespace

import numpy as np
import pytest

from cosim import FmuPlant, Scenario, build_controller, simulate
from cosim.core.logged_data import LoggedDataError, read_log
from cosim.core.protocols import Decision
from cosim.shadow import given_names, shadow


def shadowed(scenario, name, path):
    controller = build_controller(name, scenario)
    table = read_log(path, scenario, given=given_names(controller, scenario))
    return shadow(controller, table, scenario)


def logged(scenario, name, samples, folder):
    with FmuPlant(scenario) as plant:
        run = simulate(plant, build_controller(name, scenario), samples, 0)
    return run.write_csv(folder / "log.csv")


@pytest.mark.parametrize("name", ["pi", pytest.param("tuned", marks=pytest.mark.slow)])
def test_a_controller_in_its_own_shadow_does_the_same(paper, tmp_path, name):
    path = logged(paper, name, 60, tmp_path)
    result = shadowed(paper, name, path)
    assert len(result) == 60
    assert np.array_equal(result.proposed, result.logged)


@pytest.mark.slow
def test_so_does_one_behind_an_estimator(tmp_path):
    scenario = Scenario.load("late")
    path = logged(scenario, "tuned", 60, tmp_path)
    result = shadowed(scenario, "tuned", path)
    assert result.given_names == scenario.measurement_names
    assert np.array_equal(result.proposed, result.logged)


class Spy:
    """A controller that notes what it is asked and told, and wants the upper bounds."""

    name = "spy"

    def __init__(self, scenario):
        self.upper = scenario.action_upper
        self.calls = []

    def reset(self):
        self.calls.append("reset")

    def prepare(self):
        pass

    def feedback(self, s, a=None):
        self.calls.append(s[0])
        return Decision(self.upper.copy())

    def applied(self, a):
        self.calls.append(a[0])


@pytest.fixture
def table(paper):
    """A log of six rows whose X2 counts from 25 and whose P100 from 200."""
    states = np.column_stack([25.0 + np.arange(6), np.full(6, 50.0)])
    actions = np.column_stack([200.0 + np.arange(6), np.full(6, 400.0)])
    return SimpleNamespace(
        path="log.csv",
        time=60.0 * np.arange(6),
        states=states,
        actions=actions,
        excluded=np.zeros(6, bool),
        repeated=0,
    )


def test_it_is_told_what_was_applied_and_begins_anew_after_a_gap(paper, table):
    table.time[3:] += 600.0
    spy = Spy(paper)
    result = shadow(spy, table, paper)
    expected = ["reset", 25.0, 200.0, 26.0, 201.0, 27.0, 202.0]
    expected += ["reset", 28.0, 203.0, 29.0, 204.0, 30.0, 205.0]
    assert spy.calls == expected
    assert result.starts == 2


def test_it_is_not_asked_where_a_value_is_missing(paper, table):
    table.states[2, 1] = np.nan
    spy = Spy(paper)
    result = shadow(spy, table, paper)
    assert 27.0 not in spy.calls
    assert spy.calls.count("reset") == 2
    assert result.left_out == {"missing value": 1}


def test_its_table_says_how_far_it_is_from_the_log(paper, table):
    actions = shadow(Spy(paper), table, paper).actions
    assert actions["P100"]["mean_difference"] == 400.0 - 202.5
    assert actions["P100"]["largest_distance"] == 200.0
    assert actions["P100"]["largest_at"] == 0.0
    assert actions["P100"]["share_at_bound"] == 1.0
    assert actions["P100"]["logged_share_at_bound"] == 0.0
    assert actions["F200"]["mean_distance"] == 0.0
    assert actions["F200"]["logged_share_at_bound"] == 1.0


def test_another_sampling_time_is_refused(paper, table):
    table.time *= 2
    with pytest.raises(LoggedDataError, match="120 s apart"):
        shadow(Spy(paper), table, paper)
