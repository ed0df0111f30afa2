import numpy as np
import pytest

from cosim import FmuPlant
from learning import QLearning
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
