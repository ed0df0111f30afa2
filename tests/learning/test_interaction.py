import itertools

import numpy as np
import pytest

from controllers.errors import QpError
from controllers.rti import RtiNmpc
from cosim import FmuPlant, simulate
from cosim.simulation import spawn_seeds
from learning import QLearning
from learning.interaction import Interaction
from learning.starting_point import build_strategy, starting_parameters


@pytest.fixture(scope="module")
def plant(scenario):
    with FmuPlant(scenario) as plant:
        yield plant


class Idle:
    """An algorithm that learns nothing."""

    needs_action_value = True
    needs_points = True


def interaction(plant, problem, controller=None, **settings):
    configuration = QLearning.Configuration.from_dict(settings)
    controller = controller or RtiNmpc(problem, starting_parameters(problem, configuration))
    strategy = build_strategy(configuration, plant.scenario, 100)
    plant_seed, rng = spawn_seeds(4)
    made = Interaction(plant, controller, Idle(), strategy, rng)
    made.start(plant_seed)
    return made, controller


def test_without_exploration_it_is_the_closed_loop(plant, problem):
    loop, controller = interaction(plant, problem, exploration_probability=0.0)
    costs, states = [], []
    for _ in range(80):
        states.append(loop.s)
        costs.append(loop.next()[1])
    run = simulate(plant, controller, 80, 4)
    assert np.array_equal(np.array(states), run.states)
    assert np.array_equal(costs, run["stage_cost"] + run["penalty"])


def test_a_sample_is_consistent(plant, problem):
    loop, _ = interaction(plant, problem, exploration_probability=0.5)
    samples = [loop.next()[0] for _ in range(40)]
    for before, after in itertools.pairwise(samples):
        assert after.number == before.number + 1
        assert np.array_equal(after.s, before.next_s)
        assert after.policy is before.next_policy
        assert after.point is before.next_point
        assert before.explored == (before.action_value is not before.policy)
        if before.explored:
            assert before.action_value.value >= before.policy.value - 1e-6
    assert {sample.explored for sample in samples} == {True, False}
    assert loop.explored == sum(sample.explored for sample in samples)


def test_penalty_is_moved_by_one_sample(plant, problem):
    loop, _ = interaction(plant, problem)
    samples = [loop.next()[0] for _ in range(60)]
    for before, after in itertools.pairwise(samples):
        assert after.cost - after.stage_cost == pytest.approx(before.next_penalty, abs=1e-6)
    assert any(sample.next_penalty > 0 for sample in samples)


def test_literal_exploration_saturates_every_explored_sample(plant, problem):
    loop, _ = interaction(plant, problem, exploration="literal", exploration_probability=0.2)
    for _ in range(50):
        loop.next()
    assert loop.explored > 0 and loop.saturated == loop.explored


def test_perturbed_cost_explores_within_the_bounds_and_leaves_theta(plant, problem):
    loop, controller = interaction(
        plant,
        problem,
        exploration="perturbed-cost",
        exploration_probability=1.0,
        exploration_deviation=(20.0,),
    )
    theta = controller.theta.copy()
    samples = [loop.next()[0] for _ in range(20)]
    moved = np.array([sample.a - sample.policy.action for sample in samples])
    assert np.abs(moved).max() > 1.0
    assert loop.explored == 20
    assert np.array_equal(controller.theta, theta)


class Failing(RtiNmpc):
    """Fails at one call of `feedback`, like a solver."""

    calls = 0
    fails_at = 5

    def feedback(self, s, a=None):
        self.calls += 1
        if self.calls == self.fails_at:
            raise QpError("told to fail", status="failed")
        return super().feedback(s, a)


def test_a_failure_repeats_the_action_is_counted_and_learned_from_no_more(
    plant, problem, parameters
):
    loop, _ = interaction(plant, problem, Failing(problem, parameters), exploration_probability=0.0)
    got = [loop.next()[0] for _ in range(10)]
    assert [sample is None for sample in got] == [False] * 3 + [True] * 2 + [False] * 5
    assert loop.failures == 1


def test_restart_changes_nothing_that_a_resume_would_not(plant, problem):
    loop, _ = interaction(plant, problem)
    for _ in range(10):
        loop.next()
    snapshot = plant.snapshot()
    loop.restart()
    numbers, arrays = loop.state()
    rng_state = loop._rng.bit_generator.state
    first = [loop.next()[1] for _ in range(20)]
    other, _ = interaction(plant, problem)
    plant.restore(snapshot)
    other._rng.bit_generator.state = rng_state
    other.resume(numbers, arrays)
    assert [other.next()[1] for _ in range(20)] == first
