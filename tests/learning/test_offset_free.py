import numpy as np

from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim import FmuPlant, simulate
from learning.log import to_csv
from learning.offset_free import OffsetFree
from learning.prediction_errors import OneStepModel
from learning.training import run_training
from learning.training_run import begin
from tests.helpers import training
from tests.helpers.training import killed_and_resumed


def make_run(scenario="paper", settings=None, **changes):
    values = {"samples": 450, "seed": 3, "start": "tuned", "evaluation_steps": 20}
    every = {"log_every": 50, "evaluate_every": 450, "checkpoint_every": 50}
    settings = settings or {"memory": 100}
    return training.make_run("offset-free", scenario, settings, **{**values, **every, **changes})


def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(tmp_path):
    run = make_run()
    whole = run_training(run)
    resumed = killed_and_resumed(run, tmp_path, 250)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert (whole.plant_samples, whole.status) == (450, "finished")


def test_it_predicts_without_bias_under_a_wrong_model():
    run = make_run("fouled", {"back_off": False}, samples=600)
    theta = run_training(run).parameters
    problem = Problem.from_scenario(run.scenario)
    assert np.array_equal(theta["x_l"], problem.state_lower), "no back-off was asked for"
    with FmuPlant(run.scenario) as plant:
        seen = simulate(plant, RtiNmpc(problem, theta), 300, 11)
    model, naive = OneStepModel(run.scenario), Parameters.naive(problem)
    parts = seen.states[:-1], seen.actions[:-1], seen.states[1:]
    before, after = (model.errors(*parts, other).mean(axis=0) for other in (naive, theta))
    assert abs(after[1]) < 0.1 * abs(before[1])


def test_it_goes_on_and_backs_off_by_its_own_errors():
    run = make_run("fouled", samples=1400)
    with FmuPlant(run.scenario) as plant:
        loop, moved, bounds = begin(run, OffsetFree, plant), [], []
        for sample in range(1400):
            if loop.advance()[1] is not None:
                moved.append(sample)
                bounds.append([loop.parameters["x_l"][0], loop.parameters["x_u"][1]])
    lower, upper = np.array(bounds).T
    assert moved[-1] == 1399 and len(moved) == 140
    assert (lower > 25.5).sum() > len(lower) / 2 and (upper < 80.0).any()
    assert (lower >= 25.0).all() and (upper <= 80.0).all()
