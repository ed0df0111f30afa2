"""What changes in a plant that drifts stands in its log."""

import numpy as np
import pytest

from controllers.optimum import QuasiStaticPolicy
from cosim import Scenario
from learning.drift import Drift
from learning.log import COLUMNS
from tests.helpers.training import make_run, train


@pytest.fixture(scope="module")
def drifting():
    return Scenario.load("drifting")


def test_the_reference_is_that_of_the_present_heat_transfer(drifting):
    drift, policy = Drift.of(drifting), QuasiStaticPolicy.stored(drifting)
    clean, fouled = drift.row(0.0), drift.row(6 * 86400.0 - 60.0)
    assert clean == {"UA2": pytest.approx(6.84), "reference_J": policy.gains[-1][1]}
    assert fouled["UA2"] == pytest.approx(6.84 * (0.7 + 0.3 * np.exp(-1.8)), rel=1e-3)
    assert fouled["reference_J"] > clean["reference_J"] + 150.0
    assert drift.row(6 * 86400.0) == clean


def test_a_plant_that_stays_as_it_is_has_none():
    assert Drift.of(Scenario.load("fouled")) is None


def test_the_log_of_a_plant_that_jumps_shows_the_parameter_as_it_is():
    jump = Scenario.load("jump")
    drift, time = Drift.of(jump), jump.plant.changes[0].time
    assert [drift.row(t)["UA2"] for t in (0.0, time, 1e9)] == [6.84, 5.2, 6.84]
    assert drift.row(time)["reference_J"] > drift.row(0.0)["reference_J"]


@pytest.mark.parametrize(("name", "more"), [("paper", []), ("drifting", ["UA2", "reference_J"])])
def test_the_log_shows_it_at_the_end_of_each_row(name, more):
    every = {"log_every": 30, "evaluate_every": 60, "checkpoint_every": 60}
    run = make_run("offset-free", name, {"back_off": False}, samples=60, **every)
    rows = train(run).rows
    assert list(rows[0]) == [*COLUMNS, *more]
    if more:
        drift = Drift.of(run.scenario)
        assert [row["UA2"] for row in rows] == [drift.row(t)["UA2"] for t in (1800.0, 3600.0)]
