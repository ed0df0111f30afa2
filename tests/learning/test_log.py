"""The log of a training, and the judge of its θ."""

import numpy as np
import pytest

from controllers.optimum import QuasiStaticPolicy
from controllers.rti import RtiNmpc
from cosim import FmuPlant, Scenario
from cosim.simulation import indicators_of
from learning import QLearning
from learning.training import COLUMNS, FIGURES, HELD_OUT, Judge, TrainingRun, drift
from tests.helpers.training import make_run, train


@pytest.fixture(scope="module")
def drifting():
    return Scenario.load("drifting")


def test_the_reference_is_that_of_the_present_heat_transfer(drifting):
    at, policy = drift(drifting), QuasiStaticPolicy.stored(drifting)
    clean, fouled = at(0.0), at(6 * 86400.0 - 60.0)
    assert clean == {"UA2": pytest.approx(6.84), "reference_J": policy.gains[-1][1]}
    assert fouled["UA2"] == pytest.approx(6.84 * (0.7 + 0.3 * np.exp(-1.8)), rel=1e-3)
    assert fouled["reference_J"] > clean["reference_J"] + 150.0
    assert at(6 * 86400.0) == clean


def test_a_plant_that_stays_as_it_is_has_none():
    assert drift(Scenario.load("fouled")) is None


def test_the_log_of_a_plant_that_jumps_shows_the_parameter_as_it_is():
    jump = Scenario.load("jump")
    at, time = drift(jump), jump.plant.changes[0].time
    assert [at(t)["UA2"] for t in (0.0, time, 1e9)] == [6.84, 5.2, 6.84]
    assert at(time)["reference_J"] > at(0.0)["reference_J"]


@pytest.mark.parametrize(("name", "more"), [("paper", []), ("drifting", ["UA2", "reference_J"])])
def test_the_log_shows_it_at_the_end_of_each_row(name, more):
    every = {"log_every": 30, "evaluate_every": 60, "checkpoint_every": 60}
    run = make_run("offset-free", name, {"back_off": False}, samples=60, **every)
    rows = train(run).rows
    assert list(rows[0]) == [*COLUMNS, *more]
    if more:
        at = drift(run.scenario)
        assert [row["UA2"] for row in rows] == [at(t)["UA2"] for t in (1800.0, 3600.0)]


def judge(plant, parameters, divergence=1.5, optimum=None):
    run = TrainingRun(
        "q-learning", plant.scenario, 100, 0, QLearning.Configuration(), divergence=divergence,
        evaluation_seeds=1, evaluation_steps=30,
    )  # fmt: skip
    return Judge(run, plant, parameters, optimum)


def test_the_judge_sets_theta_and_evaluates_greedily(scenario, problem, parameters):
    other = parameters.replace({"x_l": np.array([26.0, 40.0])})
    with FmuPlant(scenario) as plant:
        found = judge(plant, parameters).verdict(other.theta)
        own = indicators_of(plant, RtiNmpc(problem, other), [HELD_OUT], 30)
    assert [found[name] for name in FIGURES] == [own[name][0] for name in FIGURES]


def test_the_naive_controller_is_the_judges_zero_and_the_optimum_its_one(
    scenario, problem, parameters
):
    other = RtiNmpc(problem, parameters.replace({"x_l": np.array([26.0, 40.0])}))
    with FmuPlant(scenario) as plant:
        judged = judge(plant, parameters, optimum=other)
        naive, optimum = judged.verdict(parameters.theta), judged.verdict(other.theta)
        assert (naive["gap_closed"], optimum["gap_closed"]) == (0.0, 1.0)
        best = indicators_of(plant, other, [HELD_OUT], 30)["J"][0]
        assert naive["regret"] == pytest.approx(naive["J"] / best - 1)
        assert optimum["regret"] == 0.0
        assert judged.limit == pytest.approx(1.5 * naive["J"])
        unknown = judge(plant, parameters).verdict(parameters.theta)
        assert unknown["gap_closed"] is unknown["regret"] is None
