"""Training under signals: what prices change by themselves, resumption, refusals, gain."""

import numpy as np
import pytest

from controllers.problem import Problem
from cosim import FmuPlant, Scenario
from cosim.core.errors import CosimError
from cosim.core.scenario import Penalty
from cosim.core.signals import Signals
from learning.algorithm import load_algorithm
from learning.errors import ConfigurationError
from learning.signal_costs import SignalCosts
from learning.training import run_training, train
from learning.training_run import begin_training
from tests.helpers.training import killed_and_resumed, make_run

HOURS = {
    "name": "steam_price",
    "values": [450.0, 700.0, 600.0],
    "period": 720.0,
    "price_of": "F100",
    "included": 600.0,
    "model": "steam_price",
    "known": "preview",
}
"""A price that changes every four samples."""


def test_what_prices_change_is_what_the_plant_pays_at_the_reference():
    """The nominal plant's costs with the prices less those without, and their discounted sums."""
    still = {"disturbance": {"law": "none"}}
    priced = Scenario.load("prices").replace(still | {"signal": [HOURS]})
    costs = []
    for scenario in (priced, priced.still):
        with FmuPlant(scenario) as plant:
            plant.reset(0)
            steps = [plant.step(scenario.reference_action) for _ in range(20)]
        costs.append([step.stage_cost for step in steps])
    changes = np.subtract(*costs)
    assert len(np.unique(changes.round(3))) == 3
    problem = Problem.from_scenario(priced)
    expected = SignalCosts(problem)
    known = Signals(priced)
    for k in range(10):
        stage, value = expected.of_sample(known.known(k))
        assert np.isclose(stage, changes[k], rtol=1e-6, atol=1e-6)
        ahead = problem.discounts[:-1] @ changes[k : k + problem.horizon]
        assert np.isclose(value, ahead, rtol=1e-6)


def test_a_transition_has_the_bounds_of_its_samples():
    step = {"name": "least", "values": [25.0, 30.0], "period": 240.0, "bound": "x_l[X2]"}
    scenario = Scenario.load("paper").replace({"signal": [step | {"known": "now"}]})
    run = make_run(scenario=scenario)
    weights = (scenario.penalty_linear, scenario.penalty_quadratic)
    with FmuPlant(scenario) as plant:
        loop = begin_training(run, load_algorithm("q-learning"), plant)
        for k in range(6):
            transition, _ = loop.next()
            least = [25.0, 25.0, 30.0, 30.0][(k + 1) % 4]
            assert transition.moved_penalty.lower[0] == least
            lower = np.array([least, scenario.state_lower[1]])
            penalty = Penalty(lower, scenario.state_upper, *weights)
            assert transition.next_penalty == penalty(transition.next_s.tolist())


SLOW = {"variable": "X2", "every": 3}, {"variable": "P2", "deviation": 0.5}


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("prices", {"signal": [HOURS]}),
        ("forecast", {}),
        ("forecast", {"sensor": SLOW}),
    ],
)
@pytest.mark.slow
def test_a_resumed_training_gives_the_same_digits(tmp_path, name, changes):
    """The signals are those of the sample, the restored controller and its filter know them."""
    scenario = Scenario.load(name).replace(changes)
    settings = {"prior_samples": 10, "step_every": 5}
    run = make_run(scenario=scenario, settings=settings, evaluation_seeds=0)
    whole = run_training(run, tmp_path / "whole")
    resumed = killed_and_resumed(run, tmp_path / "resumed", 20)
    assert np.array_equal(whole.learned.theta, resumed.learned.theta)
    start = whole.start.theta
    assert not np.array_equal(whole.learned.theta, start)


@pytest.mark.parametrize("algorithm", ["batch-q-learning", "actor-critic", "dyna"])
def test_a_rule_that_solves_past_samples_again_is_refused(algorithm):
    with pytest.raises(ConfigurationError, match="use q-learning, model-based or fixed"):
        train(algorithm, "prices", 40)


def test_a_signal_that_ends_before_the_training_is_refused():
    once = {key: value for key, value in HOURS.items() if key != "period"} | {"once": 720.0}
    scenario = Scenario.load("prices").replace({"signal": [once]})
    with pytest.raises(CosimError, match="ends after 720 s"):
        run_training(make_run(scenario=scenario))


@pytest.mark.slow
def test_back_offs_are_searched_where_the_bound_steps():
    """The search knows the steps to come: its θ costs less where they are met."""
    training = train("model-based", "set-point", 960, start="cautious", seed=0)
    assert training.evaluation["difference_interval"][1] < 0.0
    assert training.evaluation["violating_share"] < 1e-3


@pytest.mark.slow
def test_it_gains_where_the_price_changes_by_the_hour():
    """Whole days of held-out noise: what the price does by itself must not move θ."""
    training = train("q-learning", "prices", 1500, start="cautious", seed=0)
    assert training.run.evaluation_steps == 1440
    assert training.evaluation["difference_interval"][1] < 0.0
