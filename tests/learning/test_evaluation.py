import numpy as np
import pytest

from controllers.rti import RtiNmpc
from cosim import FmuPlant
from cosim.kpis import indicators_of
from learning import QLearning
from learning.evaluation import FIGURES, HELD_OUT, Judge
from learning.training_run import TrainingRun


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
