import dataclasses

import numpy as np
import pytest

from controllers.economic import tune
from controllers.optimum import fouling
from controllers.problem import Problem
from cosim import FmuPlant, Scenario
from learning.identified import Identified
from learning.log import to_csv
from learning.training import run_training
from learning.training_run import begin_training
from tests.helpers import training
from tests.helpers.training import killed_and_resumed


def make_run(scenario="paper", settings=None, **changes):
    values = {"samples": 450, "seed": 3, "start": "tuned", "evaluation_steps": 20}
    every = {"log_every": 50, "evaluate_every": 450, "checkpoint_every": 50}
    settings = settings or {}
    return training.make_run("identified", scenario, settings, **{**values, **every, **changes})


@pytest.mark.slow
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(tmp_path):
    run = make_run(settings={"every": 200})
    whole = run_training(run)
    resumed = killed_and_resumed(run, tmp_path, 250)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert (whole.plant_samples, whole.status) == (450, "finished")


@pytest.mark.slow
def test_it_goes_on_and_backs_off_by_its_own_errors():
    run = make_run("fouled", samples=1000)
    with FmuPlant(run.scenario) as plant:
        loop, moved, bounds = begin_training(run, Identified, plant), [], []
        for sample in range(1000):
            if loop.advance()[1] is not None:
                moved.append(sample)
                bounds.append([loop.parameters["x_l"][0], loop.parameters["x_u"][1]])
    lower, upper = np.array(bounds).T
    assert moved == [479, 959], "a shift of eight hours"
    assert (lower > 25.5).all() and (upper <= 80.0).all()


@pytest.mark.slow
def test_it_finds_the_fouled_condenser_and_tunes_with_it():
    run = make_run("fouled", samples=1200)
    theta = run_training(run).parameters
    assert theta["p"] == pytest.approx([5.2], rel=0.01)
    problem = Problem.from_scenario(run.scenario)
    model = problem.model
    fouled = dataclasses.replace(
        model,
        parameters=tuple(
            dataclasses.replace(q, nominal=float(theta["p"][0])) if q.name == "UA2" else q
            for q in model.parameters
        ),
    )
    expected = tune(dataclasses.replace(problem, model=fouled)).parameters
    for name in ("B_l", "b_l", "B_Vf", "b_Vf"):
        assert theta[name] == pytest.approx(expected[name], rel=1e-9)


@pytest.mark.slow
def test_again_and_again_it_follows_a_parameter():
    document = {"plant": {"parameters": {"fouling_rate": 30.0, "cleaning_period": 60.0}}}
    scenario = Scenario.load("drifting").replace(document)
    run = make_run(scenario, {"back_off": False, "every": 150}, start="naive")
    rows = run_training(run).rows
    _, law = fouling(scenario)
    for row in rows[3::3]:
        # The fit is of the 150 samples before it, that is of their middle.
        last = row["samples"] - row["samples"] % 150
        fitted = float(row.parameters["p"][0])
        assert fitted == pytest.approx(float(law(60.0 * (last - 75))), rel=0.03)
