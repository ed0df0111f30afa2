"""Batch Q-learning, and what its replay solves again."""

import numpy as np
import pytest

from controllers.errors import QpError
from controllers.rti import RtiNmpc
from cosim import FmuPlant
from learning import BatchQLearning, QLearning
from learning.batch_q_learning import ReplayBuffer
from learning.checkpoint import arrays_of, take_up
from learning.q_learning import AverageCost
from learning.training import TrainingRun, begin, starting_parameters
from tests.helpers.training import looped


def test_a_first_batch_has_its_own_length_and_a_start_may_keep_its_offset(scenario, problem):
    algorithm = BatchQLearning
    settings = {"first_batch": 60, "batch_size": 20}
    offsets = {}
    for measured in (True, False):
        configuration = algorithm.Configuration.from_dict(settings | {"measure_offset": measured})
        run = TrainingRun("batch-q-learning", scenario, 120, 3, configuration, start="tuned")
        with FmuPlant(scenario) as plant:
            learner = begin(run, algorithm, plant)
            updates = [learner.advance()[1] is not None for _ in range(120)]
        assert np.flatnonzero(updates).tolist() == [59, 79, 99, 119]
        offsets[measured] = learner.controller.parameters["c_f"]
    assert np.abs(offsets[False]).max() < 0.1 * np.abs(offsets[True]).max()


@pytest.fixture(scope="module")
def collected(scenario, problem):
    """Samples of a run at one θ, with their points, and the controller."""
    configuration = QLearning.Configuration(rule="fit", exploration_probability=0.4)
    controller = RtiNmpc(problem, starting_parameters(problem, configuration))
    with FmuPlant(scenario) as plant:
        interaction = looped(QLearning, plant, controller, configuration, 100, seed=5)
        interaction.algorithm.needs_points = True
        samples = [interaction.next()[0] for _ in range(60)]
    return controller, samples


def average_cost(scenario):
    return AverageCost(scenario.discount, 0, 1.0, 0.0)


def filled(controller, samples, capacity=100):
    """A buffer that these samples were put into."""
    buffer = ReplayBuffer(controller, capacity)
    for sample in samples:
        buffer.add(sample, np.zeros(2), 0.0)
    return buffer


def test_replay_at_the_same_theta_gives_the_values_of_the_run(scenario, collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    replayed = buffer.replay(average_cost(scenario))
    q = [sample.action_value.value for sample in samples]
    target = [sample.cost + scenario.discount * sample.next_policy.value for sample in samples]
    assert replayed.rows.tolist() == list(range(60))
    assert replayed.action_value == pytest.approx(q, rel=1e-9)
    assert replayed.target == pytest.approx(target, rel=1e-9)
    assert replayed.gradient == pytest.approx(
        np.array([s.action_value.value_gradient for s in samples]), rel=1e-6, abs=1e-6
    )
    assert any(sample.explored for sample in samples)
    assert replayed.failures == 0


def test_replay_sees_the_present_theta(scenario, collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    before = buffer.replay(average_cost(scenario))
    theta = controller.theta.copy()
    h = 1e-3
    position = controller.parameters.blocks.slices["b_l"].start
    moved = theta.copy()
    moved[position] += h
    try:
        controller.theta = moved
        after = buffer.replay(average_cost(scenario))
    finally:
        controller.theta = theta
    assert_same(buffer.replay(average_cost(scenario)), before)
    slope = (after.action_value - before.action_value) / h
    assert slope == pytest.approx(before.gradient[:, position], rel=1e-3, abs=1e-3)


class Counting:
    """A controller that counts its feedbacks, and may fail at every one, like a solver."""

    def __init__(self, controller, *, memoryless=True, fails=False):
        self._controller, self.memoryless, self.fails = controller, memoryless, fails
        self.feedbacks = 0

    @property
    def theta(self):
        return self._controller.theta

    @theta.setter
    def theta(self, theta):
        self._controller.theta = theta

    def prepare_at(self, point):
        self._controller.prepare_at(point)

    def feedback(self, *arguments):
        self.feedbacks += 1
        if self.fails:
            raise QpError("told to fail", status="failed")
        return self._controller.feedback(*arguments)


def replayed(controller, samples, cost):
    """A replay that remembers nothing."""
    buffer = filled(Counting(controller, memoryless=False), samples)
    return buffer.replay(cost)


def assert_same(first, second):
    for name in ("rows", "action_value", "target", "gradient", "failures"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


def test_what_the_loop_solved_is_not_solved_again(scenario, collected):
    controller, samples = collected
    counting = Counting(controller)
    buffer = filled(counting, samples)
    found = buffer.replay(average_cost(scenario))
    assert counting.feedbacks == sum(sample.explored for sample in samples)
    assert_same(found, replayed(controller, samples, average_cost(scenario)))


def test_qps_that_fail_are_counted_and_their_rows_left_out(scenario, collected):
    controller, samples = collected
    buffer = filled(Counting(controller, fails=True), samples)
    found = buffer.replay(average_cost(scenario))
    explored = [sample.explored for sample in samples]
    assert found.failures == sum(explored) > 0
    assert found.rows.tolist() == np.flatnonzero(np.logical_not(explored)).tolist()


def test_a_new_batch_knows_nothing_of_the_one_before(scenario, collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    buffer.replay(average_cost(scenario))
    buffer.clear()
    for sample in samples[30:]:
        buffer.add(sample, np.zeros(2), 0.0)
    found = buffer.replay(average_cost(scenario))
    assert_same(found, replayed(controller, samples[30:], average_cost(scenario)))


def test_a_restored_buffer_remembers_what_was_solved(scenario, collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    first = buffer.replay(average_cost(scenario))
    counting = Counting(controller)
    other = ReplayBuffer(counting, 100)
    take_up(other, arrays_of(buffer))
    assert_same(other.replay(average_cost(scenario)), first)
    assert counting.feedbacks == 0
