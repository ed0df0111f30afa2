import numpy as np
import pytest

from cosim import FmuPlant
from learning.algorithm import load_algorithm
from learning.loop import begin
from learning.training_run import TrainingRun

ALGORITHMS = ("q-learning", "batch-q-learning", "actor-critic")
SETTINGS = {
    "q-learning": {"prior_samples": 40, "step_every": 20},
    "batch-q-learning": {"batch_size": 40},
    "actor-critic": {"batch_size": 60},
}


def learner(plant, name, samples=1500, **settings):
    algorithm = load_algorithm(name)
    configuration = algorithm.Configuration.from_dict({**SETTINGS[name], **settings})
    run = TrainingRun(name, plant.scenario, samples, 3, configuration)
    return begin(run, algorithm, plant)


@pytest.fixture(scope="module")
def plant(scenario):
    with FmuPlant(scenario) as plant:
        yield plant


@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_is_handed_over_is_the_incumbent_and_its_trials_are_greedy(plant, name):
    made = learner(plant, name)
    start = made.start_parameters.theta.copy()
    explored_in_trials, thetas = 0, []
    for _ in range(1500):
        explores, before = made.algorithm.explores, made.counts.explored
        made.advance()
        explored_in_trials += not explores and made.counts.explored > before
        thetas.append(made.parameters.theta)
    assert explored_in_trials == 0 < made.counts.explored
    assert np.array_equal(thetas[0], start)
    assert not np.array_equal(thetas[-1], start), "the naive start is easily beaten"


def test_without_globalisation_the_rule_moves_what_is_handed_over(plant):
    made = learner(plant, "q-learning", 100, globalisation="none")
    for _ in range(100):
        made.advance()
    assert made.algorithm.theta is None
    assert not np.array_equal(made.parameters.theta, made.start_parameters.theta)


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("at", [90, 400])
def test_a_restored_search_goes_on_as_the_first_one(scenario, name, at):
    """At 90 samples a phase of learning is open, at 400 a race."""
    with FmuPlant(scenario) as first, FmuPlant(scenario) as second:
        whole, resumed = learner(first, name), learner(second, name)
        for _ in range(at):
            whole.advance()
        whole.restart()
        second.restore(second.deserialise(first.serialise(first.snapshot())))
        resumed.restore(*whole.state())
        for _ in range(500):
            whole.advance()
            resumed.advance()
            assert np.array_equal(whole.s, resumed.s)
        assert np.array_equal(whole.controller.theta, resumed.controller.theta)
        assert np.array_equal(whole.parameters.theta, resumed.parameters.theta)


def test_the_last_race_begins_a_new_episode(plant):
    made, seeds = learner(plant, "q-learning"), []
    go_on = made.start

    def start(s):
        seeds.append(made.counts.number)
        go_on(s)
        assert np.array_equal(made.s, plant.scenario.initial_state)

    made.start = start
    for _ in range(1500):
        made.advance()
    assert len(seeds) == 1
    assert 0.6 * 1500 < seeds[0] < 0.8 * 1500
