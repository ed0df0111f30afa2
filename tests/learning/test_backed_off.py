from functools import partial

import numpy as np
import pytest

from controllers.economic import tune
from controllers.errors import QpError, TuningError
from controllers.factories import build_controller
from controllers.rti import RtiNmpc
from cosim.core.simulation import simulate
from cosim.core.training_options import TrainingOptions
from cosim.plant import FmuPlant
from learning import training_run
from learning.backed_off import add_reserve, back_off
from learning.training_run import make_run


@pytest.fixture(scope="module")
def tuned(problem):
    return tune(problem).parameters


def short(tuned, scenario, **settings):
    return back_off(tuned, scenario, samples=1000, **settings)


@pytest.mark.slow
def test_the_first_days_theta_is_tuned_and_backed_off_where_the_model_is_active(scenario, tuned):
    theta = build_controller("backed-off", scenario).parameters
    assert 26.0 < theta["x_l"][0] < 30.0
    assert theta["x_u"].tolist() == scenario.state_upper.tolist()
    for name in ("B_l", "b_l", "B_Vf", "b_Vf", "c_f"):
        assert np.array_equal(theta[name], tuned[name])


def test_the_plant_says_nothing_of_it(scenario, tuned):
    other = scenario.replace(
        {"plant": {"parameters": {"UA2": 5.2}}, "disturbance": {"law": "normal"}}
    )
    assert np.array_equal(short(tuned, scenario).theta, short(tuned, other).theta)


def test_a_training_starts_with_it(scenario, monkeypatch):
    monkeypatch.setattr(training_run, "back_off", partial(back_off, samples=1000))
    run = make_run("q-learning", scenario, 1000, options=TrainingOptions(start="backed-off"))
    start = run.starting_parameters()
    assert start["x_l"][0] > 25.0 and "w_sigma" in start.blocks
    assert np.array_equal(start.theta, run.starting_parameters().theta)


@pytest.mark.parametrize("search", [back_off, add_reserve])
def test_a_model_of_which_no_sample_is_solved_is_refused(scenario, tuned, monkeypatch, search):
    def fail(self, s, a=None):
        raise QpError("no", status="no")

    monkeypatch.setattr(RtiNmpc, "feedback", fail)
    with pytest.raises(TuningError, match=f"'{scenario.name}': no sample .* was solved"):
        # Another noise than that of any other test: a search is kept.
        search(tuned, scenario, deviation=0.07, samples=1000)


def test_without_noise_nothing_is_backed_off(scenario, tuned):
    theta = short(tuned, scenario, deviation=0.0)
    assert theta["x_l"].tolist() == pytest.approx([25.0, 40.0])


def test_a_bound_that_is_not_active_has_a_reserve_that_costs_nothing(scenario, problem, tuned):
    start = short(tuned, scenario)
    cautious = add_reserve(start, scenario)
    assert cautious["x_l"][0] == start["x_l"][0]  # it is active
    assert (cautious["x_u"] < start["x_u"]).all() and cautious["x_l"][1] > start["x_l"][1]
    costs = []
    with FmuPlant(scenario) as plant:
        for theta in (cautious, start):
            run = simulate(plant, RtiNmpc(problem, theta), 200, 0)
            costs.append(run.signals["stage_cost"].values)
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)
