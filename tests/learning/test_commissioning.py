import numpy as np
import pytest

from controllers.economic import tune
from cosim.plant import FmuPlant
from cosim.plugins import build_controller
from cosim.simulation import simulate
from learning import commissioning
from learning.training import prepare


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(commissioning, "SAMPLES", 1000)
    monkeypatch.setattr(commissioning, "_found", {})


def test_the_first_days_theta_is_tuned_and_backed_off_where_the_model_binds(scenario, problem):
    found, tuned = build_controller("commissioned", scenario).parameters, tune(problem).parameters
    assert 26.0 < found["x_l"][0] < 30.0
    assert found["x_u"].tolist() == scenario.state_upper.tolist()
    for name in ("B_l", "b_l", "B_Vf", "b_Vf", "c_f"):
        assert np.array_equal(found[name], tuned[name])


def test_the_plant_says_nothing_of_it(scenario, short):
    other = scenario.replace(
        {"plant": {"parameters": {"UA2": 5.2}}, "disturbance": {"law": "normal"}}
    )
    one, two = (build_controller("commissioned", s).parameters for s in (scenario, other))
    assert np.array_equal(one.theta, two.theta)


def test_a_training_starts_with_it(scenario, short):
    run = prepare("q-learning", scenario, 1000, None, {"seed": 0, "start": "commissioned"})
    start = run.starting_parameters()
    assert start["x_l"][0] > 25.0 and "w_sigma" in start.blocks
    assert np.array_equal(start.theta, run.starting_parameters().theta)


def test_without_noise_nothing_is_backed_off(scenario, short, monkeypatch):
    monkeypatch.setattr(commissioning, "GUESS", 0.0)
    found = build_controller("commissioned", scenario).parameters
    assert found["x_l"].tolist() == pytest.approx([25.0, 40.0])


def test_a_bound_that_does_not_bind_has_a_spare_back_off_that_costs_nothing(scenario, short):
    found, start = (build_controller(name, scenario) for name in ("cautious", "commissioned"))
    one, other = found.parameters, start.parameters
    assert one["x_l"][0] == other["x_l"][0]  # it binds
    assert (one["x_u"] < other["x_u"]).all() and one["x_l"][1] > other["x_l"][1]
    with FmuPlant(scenario) as plant:
        costs = [simulate(plant, c, 200, 0).signals["stage_cost"].values for c in (found, start)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)
