import numpy as np
import pytest

from controllers.rti import RtiNmpc
from cosim import FmuPlant
from learning import QLearning
from learning.average_cost import AverageCost
from learning.interaction import Interaction
from learning.replay import ReplayBuffer
from learning.starting_point import build_strategy, starting_parameters


@pytest.fixture(scope="module")
def collected(scenario, problem):
    """Samples of a run at one θ, with their points, and the controller."""
    configuration = QLearning.Configuration(
        line_search=True, rule="fit", exploration_probability=0.4
    )
    controller = RtiNmpc(problem, starting_parameters(problem, configuration))
    strategy = build_strategy(configuration, scenario, 100)
    algorithm = QLearning(
        controller, scenario, configuration, 100, strategy, np.random.default_rng(0)
    )
    with FmuPlant(scenario) as plant:
        interaction = Interaction(plant, controller, algorithm, strategy, np.random.default_rng(0))
        interaction.start(5)
        samples = [interaction.next()[0] for _ in range(60)]
    return controller, samples


def average_cost(scenario):
    return AverageCost(scenario.discount, 0, 1.0, 0.0)


def test_replay_at_the_same_theta_gives_the_values_of_the_run(scenario, collected):
    controller, samples = collected
    buffer = ReplayBuffer(100)
    for sample in samples:
        buffer.add(sample)
    replayed = buffer.replay(controller, average_cost(scenario))
    q = [sample.action_value.value for sample in samples]
    target = [sample.cost + scenario.discount * sample.next_policy.value for sample in samples]
    assert replayed.number.tolist() == list(range(60))
    assert replayed.action_value == pytest.approx(q, rel=1e-9)
    assert replayed.target == pytest.approx(target, rel=1e-9)
    assert replayed.gradient == pytest.approx(
        np.array([s.action_value.value_gradient for s in samples]), rel=1e-6, abs=1e-6
    )
    assert any(sample.explored for sample in samples)
    assert replayed.failures == 0


def test_a_full_buffer_forgets_the_oldest(scenario, collected):
    controller, samples = collected
    buffer = ReplayBuffer(20)
    for sample in samples:
        buffer.add(sample)
    assert len(buffer) == 20
    assert buffer.replay(controller, average_cost(scenario)).number.tolist() == list(range(40, 60))


def test_transitions_that_do_not_follow_each_other_share_nothing(scenario, collected):
    controller, samples = collected
    whole, gaps = ReplayBuffer(100), ReplayBuffer(100)
    for sample in samples:
        whole.add(sample)
    for sample in samples[::3]:
        gaps.add(sample)
    expected = whole.replay(controller, average_cost(scenario))
    found = gaps.replay(controller, average_cost(scenario))
    assert found.td_error == pytest.approx(expected.td_error[::3], rel=1e-9, abs=1e-6)


def test_replay_sees_the_present_theta(scenario, collected):
    controller, samples = collected
    buffer = ReplayBuffer(100)
    for sample in samples:
        buffer.add(sample)
    before = buffer.replay(controller, average_cost(scenario))
    theta = controller.theta.copy()
    h = 1e-3
    position = controller.parameters.blocks.slices["b_l"].start
    moved = theta.copy()
    moved[position] += h
    try:
        controller.theta = moved
        after = buffer.replay(controller, average_cost(scenario))
    finally:
        controller.theta = theta
    slope = (after.action_value - before.action_value) / h
    assert slope == pytest.approx(before.gradient[:, position], rel=1e-3, abs=1e-3)


def test_a_restored_buffer_replays_alike(scenario, collected):
    controller, samples = collected
    buffer, other = ReplayBuffer(20), ReplayBuffer(20)
    for sample in samples[:30]:
        buffer.add(sample)
    other.restore(buffer.state())
    for sample in samples[30:35]:
        buffer.add(sample)
        other.add(sample)
    first = buffer.replay(controller, average_cost(scenario))
    controller.reset()
    second = other.replay(controller, average_cost(scenario))
    assert np.array_equal(first.number, second.number)
    assert first.td_error == pytest.approx(second.td_error, rel=1e-9, abs=1e-6)
