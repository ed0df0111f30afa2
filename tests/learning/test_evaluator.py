import numpy as np
import pytest

from controllers.rti import RtiNmpc
from cosim import FmuPlant
from cosim.core.simulation import indicators_of
from cosim.core.training_options import HELD_OUT
from learning.evaluator import Evaluator
from learning.log import METRICS
from tests.helpers.training import make_run


def evaluator(plant, parameters, optimum=None):
    run = make_run("q-learning", plant.scenario, divergence=1.5, evaluation_steps=30)
    return Evaluator(run, plant, parameters, optimum)


def test_it_sets_theta_and_evaluates_greedily(scenario, problem, parameters):
    other = parameters.replace({"x_l": np.array([26.0, 40.0])})
    with FmuPlant(scenario) as plant:
        metrics = evaluator(plant, parameters).evaluate(other.theta)
        own = indicators_of(plant, RtiNmpc(problem, other), [HELD_OUT], 30)
    assert [metrics[name] for name in METRICS] == [own[name][0] for name in METRICS]


def test_the_start_is_its_zero_the_optimum_its_one(scenario, problem, parameters):
    other = RtiNmpc(problem, parameters.replace({"x_l": np.array([26.0, 40.0])}))
    near = parameters.replace({"x_l": np.array([25.3, 40.0])})
    with FmuPlant(scenario) as plant:
        evaluating = evaluator(plant, near, optimum=other)
        start, optimum = evaluating.evaluate(near.theta), evaluating.evaluate(other.theta)
        assert (start["gap_closed"], optimum["gap_closed"]) == (0.0, 1.0)
        assert (start["difference"], start["J"]) == (0.0, evaluating.start["J"])
        naive = evaluating.evaluate(parameters.theta)
        best = indicators_of(plant, other, [HELD_OUT], 30)["J"][0]
        assert naive["regret"] == pytest.approx(naive["J"] / best - 1)
        assert optimum["regret"] == 0.0
        assert evaluating.limit == pytest.approx(1.5 * naive["J"])
        unknown = evaluator(plant, parameters).evaluate(parameters.theta)
        assert unknown["gap_closed"] is unknown["regret"] is None


def test_runs_that_start_alike_share_their_evaluation(scenario, parameters):
    run = make_run("q-learning", scenario, divergence=1.5, evaluation_steps=30)
    known = {}
    with FmuPlant(scenario) as plant:
        first = Evaluator(run, plant, parameters, None, known)
    again = Evaluator(run, None, parameters, None, known)
    assert again.start == first.start and again.limit == first.limit
    assert first.samples > 0 and again.samples == 0
