import dataclasses

import numpy as np
import pytest

from cosim import FmuPlant, Scenario
from learning import QLearning
from learning.errors import ConfigurationError
from learning.learner import Learner
from learning.protocols import Update
from learning.training_run import TrainingRun


@pytest.fixture
def plant(scenario):
    with FmuPlant(scenario) as plant:
        yield plant


def make_run(scenario, seed=3):
    configuration = QLearning.Configuration.from_dict({"rule": "gauss-newton", "warm_up": 20})
    return TrainingRun("q-learning", scenario, 100, seed, configuration)


class Counting(QLearning):
    """Moves nothing, but says on every sample that it did and that two QPs failed."""

    def observe(self, sample):
        return Update(td_error=1.0, step=0.0, smallest_eigenvalue=1.0, failures=2)


def costs(plant, seed):
    learner = Learner(make_run(plant.scenario, seed), QLearning, plant)
    learner.begin()
    return [learner.advance()[0] for _ in range(30)]


def test_the_runs_seed_gives_the_samples(plant):
    assert costs(plant, 3) == costs(plant, 3)
    assert costs(plant, 3) != costs(plant, 4)


def test_an_update_is_reported_where_theta_moves(plant):
    learner = Learner(make_run(plant.scenario), QLearning, plant)
    learner.begin()
    for number in range(40):
        before = learner.controller.theta.copy()
        _, update = learner.advance()
        assert (update is not None) == (number == 39)
        assert np.array_equal(before, learner.controller.theta) == (update is None)
    assert not np.array_equal(learner.start.theta, learner.controller.theta)


def test_failures_of_an_update_count_with_those_of_the_loop(plant):
    learner = Learner(make_run(plant.scenario), Counting, plant)
    learner.begin()
    for _ in range(5):
        learner.advance()
    assert learner.interaction.failures == 10


def test_a_rule_that_rests_neither_moves_nor_explores(plant):
    run = dataclasses.replace(make_run(plant.scenario), rest_after=40)
    learner = Learner(run, QLearning, plant)
    learner.begin()
    updates = [learner.advance()[1] for _ in range(40)]
    assert updates[-1] is not None
    theta, explored = learner.controller.theta.copy(), learner.interaction.explored
    assert explored > 0
    assert [learner.advance()[1] for _ in range(40)] == [None] * 40
    np.testing.assert_array_equal(learner.controller.theta, theta)
    assert learner.interaction.explored == explored


def test_a_rest_begins_after_a_sample():
    with pytest.raises(ConfigurationError, match="rest_after must be at least 1"):
        dataclasses.replace(make_run(Scenario.load("paper")), rest_after=0)
