"""The search as an algorithm on the evaporator, and what a checkpoint keeps of it."""

import numpy as np
import pytest

from cosim import FmuPlant
from learning import search
from learning.search import Search
from learning.training import TrainingRun, begin

SETTINGS = {
    "none": {},
    "q-learning": {},
    "batch-q-learning": {},
    "actor-critic": {"q_learning_first": True},
}


@pytest.fixture(autouse=True)
def quick_rules(monkeypatch):
    short = {"prior_samples": 40, "step_every": 20, "batch_size": 40}
    monkeypatch.setattr(search, "RULE_DEFAULTS", search.RULE_DEFAULTS | short)


def learner(plant, rule, samples=1500):
    configuration = Search.Configuration.from_dict({"rule": rule, **SETTINGS[rule]})
    run = TrainingRun("search", plant.scenario, samples, 3, configuration)
    return begin(run, Search, plant)


@pytest.mark.parametrize("rule", SETTINGS)
def test_what_is_handed_over_is_the_incumbent_and_its_trials_are_greedy(plant, rule):
    made = learner(plant, rule)
    start = made.start_parameters.theta.copy()
    explored_in_trials, thetas = 0, []
    for _ in range(1500):
        explores, before = made.algorithm.explores, made.counts.explored
        made.advance()
        explored_in_trials += not explores and made.counts.explored > before
        thetas.append(made.parameters.theta)
    assert explored_in_trials == 0
    assert (made.counts.explored > 0) == (rule != "none")
    assert np.array_equal(thetas[0], start)
    assert not np.array_equal(thetas[-1], start), "the naive start is easily beaten"


def test_a_search_explores_as_its_rule_does():
    make = Search.Configuration.from_dict
    for rule, probability in (("none", 0.3), ("q-learning", 0.3), ("actor-critic", 1.0)):
        assert make({"rule": rule}).exploration_probability == probability
    assert (
        make({"rule": "actor-critic", "exploration_probability": 0.5}).exploration_probability
        == 0.5
    )


@pytest.mark.parametrize("rule", SETTINGS)
def test_a_restored_search_goes_on_as_the_first_one(scenario, rule):
    """At 400 samples a comparison is open."""
    with FmuPlant(scenario) as first, FmuPlant(scenario) as second:
        whole, resumed = learner(first, rule), learner(second, rule)
        for _ in range(400):
            whole.advance()
        whole.restart()
        second.restore(second.deserialise(first.serialise(first.snapshot())))
        resumed.restore(whole.state())
        for _ in range(500):
            whole.advance()
            resumed.advance()
            assert np.array_equal(whole.s, resumed.s)
        assert np.array_equal(whole.controller.theta, resumed.controller.theta)
        assert np.array_equal(whole.parameters.theta, resumed.parameters.theta)
