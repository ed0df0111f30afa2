import numpy as np
import pytest

from controllers.rti import RtiNmpc
from cosim import FmuPlant, simulate
from learning import QLearning
from learning.evaluation import HELD_OUT, HeldOutRuns, Judge, gap_closed, held_out
from learning.training_run import TrainingRun


def test_evaluation_is_the_closed_loop_on_the_held_out_seeds(scenario, problem, parameters):
    with FmuPlant(scenario) as plant:
        controller = RtiNmpc(problem, parameters)
        costs = HeldOutRuns(plant, held_out(2), 30).costs(controller)
        runs = [simulate(plant, controller, 30, HELD_OUT + k).summary() for k in range(2)]
        means = HeldOutRuns(plant, held_out(2), 30).means(controller)
    for name in costs:
        assert costs[name].tolist() == [run[name] for run in runs]
    assert means["J"] == pytest.approx(np.mean([run["J"] for run in runs]))


def test_gap_closed_is_zero_for_naive_and_one_for_the_optimum():
    assert gap_closed(28_000.0, 28_000.0, 6300.0) == 0.0
    assert gap_closed(6300.0, 28_000.0, 6300.0) == 1.0


def judge(plant, parameters, divergence=1.5, optimum=None):
    run = TrainingRun(
        "q-learning", plant.scenario, 100, 0, QLearning.Configuration(), divergence=divergence,
        evaluation_seeds=1, evaluation_steps=30,
    )  # fmt: skip
    return Judge(run, plant, parameters, optimum)


def test_the_judge_sets_theta_and_evaluates_greedily(scenario, problem, parameters):
    other = parameters.replace({"x_l": np.array([26.0, 40.0])})
    with FmuPlant(scenario) as plant:
        found = judge(plant, parameters).figures(other.theta)
        assert found == HeldOutRuns(plant, held_out(1), 30).means(RtiNmpc(problem, other))


def test_the_naive_controller_is_the_judges_zero_and_the_optimum_its_one(
    scenario, problem, parameters
):
    other = RtiNmpc(problem, parameters.replace({"x_l": np.array([26.0, 40.0])}))
    with FmuPlant(scenario) as plant:
        judged = judge(plant, parameters, optimum=other)
        naive = judged.figures(parameters.theta)["J"]
        optimum = HeldOutRuns(plant, held_out(1), 30).means(other)["J"]
        assert (judged.gap_closed(naive), judged.gap_closed(optimum)) == (0.0, 1.0)
        assert judged.limit == pytest.approx(1.5 * naive)
        assert np.isnan(judge(plant, parameters).gap_closed(naive))
