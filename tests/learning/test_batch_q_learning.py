"""Batch Q-learning, and what its replay solves again."""

import numpy as np
import pytest

from controllers.errors import QpError
from controllers.rti import RtiNmpc
from cosim import FmuPlant
from learning import BatchQLearning, QLearning
from learning.batch_q_learning import ReplayBuffer
from learning.training_run import TrainingRun, begin_training, starting_parameters
from tests.helpers.training import looped


def test_a_first_batch_has_its_own_length_and_a_start_may_keep_its_offset(scenario, problem):
    algorithm = BatchQLearning
    settings = {"first_batch": 60, "batch_size": 20}
    offsets = {}
    for measured in (True, False):
        configuration = algorithm.Configuration.from_dict(settings | {"measure_offset": measured})
        run = TrainingRun("batch-q-learning", scenario, 120, configuration, seed=3, start="tuned")
        with FmuPlant(scenario) as plant:
            learner = begin_training(run, algorithm, plant)
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


def filled(controller, samples, capacity=100):
    """A buffer that these samples were put into."""
    buffer = ReplayBuffer(controller, capacity)
    for sample in samples:
        buffer.add(sample, np.zeros(2), 0.0)
    return buffer


def test_replay_at_the_same_theta_gives_the_values_of_the_run(collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    kept, action_value, next_value, gradient = buffer.replay()
    q = [sample.q_solution.value for sample in samples]
    following = [sample.next_solution.value for sample in samples]
    assert kept.tolist() == [True] * 60
    assert action_value == pytest.approx(q, rel=1e-9)
    assert next_value == pytest.approx(following, rel=1e-9)
    assert gradient == pytest.approx(
        np.array([s.q_solution.value_gradient for s in samples]), rel=1e-6, abs=1e-6
    )
    assert any(sample.explored for sample in samples)


def test_replay_sees_the_present_theta(collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    before = buffer.replay()
    theta = controller.theta.copy()
    h = 1e-3
    position = controller.parameters.blocks.slices["b_l"].start
    moved = theta.copy()
    moved[position] += h
    try:
        controller.theta = moved
        after = buffer.replay()
    finally:
        controller.theta = theta
    assert_same(buffer.replay(), before)
    slope = (after[1] - before[1]) / h
    assert slope == pytest.approx(before[3][:, position], rel=1e-3, abs=1e-3)


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


def replayed(controller, samples):
    """A replay that remembers nothing."""
    buffer = filled(Counting(controller, memoryless=False), samples)
    return buffer.replay()


def assert_same(first, second):
    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one, other)


def test_what_the_loop_solved_is_not_solved_again(collected):
    controller, samples = collected
    counting = Counting(controller)
    buffer = filled(counting, samples)
    found = buffer.replay()
    assert counting.feedbacks == sum(sample.explored for sample in samples)
    assert_same(found, replayed(controller, samples))


def test_qps_that_fail_are_counted_and_their_rows_left_out(collected):
    controller, samples = collected
    buffer = filled(Counting(controller, fails=True), samples)
    kept = buffer.replay()[0]
    explored = [sample.explored for sample in samples]
    assert kept.tolist() == np.logical_not(explored).tolist() and any(explored)


def test_a_new_batch_knows_nothing_of_the_one_before(collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    buffer.replay()
    buffer.clear()
    for sample in samples[30:]:
        buffer.add(sample, np.zeros(2), 0.0)
    found = buffer.replay()
    assert_same(found, replayed(controller, samples[30:]))


def test_a_restored_buffer_remembers_what_was_solved(collected):
    controller, samples = collected
    buffer = filled(controller, samples)
    first = buffer.replay()
    counting = Counting(controller)
    other = ReplayBuffer(counting, 100)
    other.load_state_dict(buffer.state_dict())
    assert_same(other.replay(), first)
    assert counting.feedbacks == 0


def theta_after(collected, scenario, problem, change, settings):
    """θ that batches of 20 of the collected samples lead to, changed by number."""
    samples = collected[1]
    configuration = BatchQLearning.Configuration.from_dict({"batch_size": 20} | settings)
    controller = RtiNmpc(problem, starting_parameters(problem, configuration))
    with FmuPlant(scenario) as plant:
        algorithm = looped(BatchQLearning, plant, controller, configuration, 60, seed=5).algorithm
    for number, sample in enumerate(samples):
        algorithm.observe(change(number, sample))
    return controller.theta


def test_no_single_sample_decides(collected, scenario, problem):
    """A cost that is out of all bounds moves θ as far as any other such cost."""

    def theta_with(cost):
        def broken_once(number, sample):
            return sample._replace(cost=cost) if number == 30 else sample

        settings = {"intercept": False}
        return theta_after(collected, scenario, problem, broken_once, settings)

    assert np.array_equal(theta_with(1e9), theta_with(1e12))


def test_only_the_expected_penalty_of_the_next_state_counts(collected, scenario, problem):
    """What a sample's next penalty was by chance takes no part: its expectation stands for it."""

    def as_it_was(number, sample):
        return sample

    def moved_into_the_next_penalty(number, sample):
        part = 7.0 * (number % 3)
        return sample._replace(cost=sample.cost + part, next_penalty=sample.next_penalty + part)

    before = theta_after(collected, scenario, problem, as_it_was, {})
    after = theta_after(collected, scenario, problem, moved_into_the_next_penalty, {})
    assert after == pytest.approx(before, rel=1e-9, abs=1e-9)


def test_errors_that_last_count_for_less(collected, scenario, problem):
    """Where the warm-up's errors are correlated in time, a batch moves θ by a shorter step."""
    _, samples = collected

    def step_with(doubt):
        settings = {"batch_size": 60, "relinearisations": 1, "persistence_doubt": doubt}
        configuration = BatchQLearning.Configuration.from_dict(settings)
        controller = RtiNmpc(problem, starting_parameters(problem, configuration))
        with FmuPlant(scenario) as plant:
            algorithm = looped(
                BatchQLearning, plant, controller, configuration, 60, seed=5
            ).algorithm
        for number, sample in enumerate(samples):
            lasting = np.array([1.0, 3.0]) * np.sin(number / 4)
            update = algorithm.observe(sample._replace(next_s=sample.next_s + lasting))
        return update.step

    assert 0 < step_with(4.0) < 0.9 * step_with(1e9)
