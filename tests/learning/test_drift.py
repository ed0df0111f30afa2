"""What changes in a plant that drifts stands in its log."""

import numpy as np
import pytest

from controllers.quasi_static import QuasiStaticPolicy
from cosim import FmuPlant, Scenario
from learning.drift import Drift
from learning.log import COLUMNS
from learning.registry import load_algorithm
from learning.training_loop import TrainingLoop
from learning.training_run import TrainingRun


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


@pytest.mark.parametrize(("name", "more"), [("paper", []), ("drifting", ["UA2", "reference_J"])])
def test_the_log_shows_it_at_the_end_of_each_row(name, more):
    scenario, algorithm = Scenario.load(name), load_algorithm("offset-free")
    run = TrainingRun(
        algorithm="offset-free",
        scenario=scenario,
        samples=60,
        seed=0,
        configuration=algorithm.Configuration.from_dict({"back_off": False}),
        log_every=30,
        evaluate_every=60,
        checkpoint_every=60,
        evaluation_seeds=1,
        evaluation_steps=5,
    )
    with FmuPlant(scenario) as plant, FmuPlant(scenario) as other:
        rows = TrainingLoop(run, algorithm, plant, other).go().rows
    assert list(rows[0]) == [*COLUMNS, *more]
    if more:
        drift = Drift.of(scenario)
        assert [row["UA2"] for row in rows] == [drift.row(t)["UA2"] for t in (1800.0, 3600.0)]
