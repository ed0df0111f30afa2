import numpy as np
import pytest

from controllers.rti import RtiNmpc
from cosim import FmuPlant, simulate
from learning.evaluation import HELD_OUT, Evaluation, gap_closed, held_out


def test_evaluation_is_the_closed_loop_on_the_held_out_seeds(scenario, problem, parameters):
    with FmuPlant(scenario) as plant:
        controller = RtiNmpc(problem, parameters)
        costs = Evaluation(plant, held_out(2), 30).costs(controller)
        runs = [simulate(plant, controller, 30, HELD_OUT + k).summary() for k in range(2)]
        means = Evaluation(plant, held_out(2), 30).means(controller)
    for name in costs:
        assert costs[name].tolist() == [run[name] for run in runs]
    assert means["J"] == pytest.approx(np.mean([run["J"] for run in runs]))


def test_gap_closed_is_zero_for_naive_and_one_for_the_optimum():
    assert gap_closed(28_000.0, 28_000.0, 6300.0) == 0.0
    assert gap_closed(6300.0, 28_000.0, 6300.0) == 1.0
