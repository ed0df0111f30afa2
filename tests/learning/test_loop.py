import dataclasses
import itertools
from types import ModuleType
from typing import ClassVar

import numpy as np
import pytest

from controllers.errors import QpError
from controllers.rti import RtiNmpc
from cosim import FmuPlant, simulate
from cosim.core.simulation import spawn_seeds
from cosim.core.training_options import HELD_OUT
from learning import QLearning
from learning.algorithm import Update
from learning.errors import ConfigurationError, PrivilegeError
from learning.exploration import Strategy
from learning.loop import PlantInOperation, TrainingLoop
from learning.training import run_training
from learning.training_run import TrainingRun, begin_training, starting_parameters


class Idle:
    """An algorithm that learns nothing."""

    requires = "operation"
    needs_q_solution = True
    needs_points = True

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def interaction(plant, problem, controller=None, **settings):
    configuration = QLearning.Configuration.from_dict(settings)
    controller = controller or RtiNmpc(problem, starting_parameters(problem, configuration))
    strategy = Strategy(configuration, plant.scenario)
    plant_seed, rng = spawn_seeds(4)
    made = TrainingLoop(plant, controller, Idle(), strategy, rng)
    made.start(plant.reset(plant_seed))
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
        assert after.solution is before.next_solution
        assert after.point is before.next_point
        assert after.cost - after.stage_cost == pytest.approx(before.next_penalty, abs=1e-6)
        assert before.explored == (before.q_solution is not before.solution)
        if before.explored:
            assert before.q_solution.value >= before.solution.value - 1e-6
    assert any(sample.next_penalty > 0 for sample in samples)
    assert {sample.explored for sample in samples} == {True, False}
    assert loop.counts.explored == sum(sample.explored for sample in samples)


def test_literal_exploration_saturates_every_explored_sample(plant, problem):
    loop, _ = interaction(plant, problem, exploration="literal", exploration_probability=0.2)
    for _ in range(50):
        loop.next()
    assert loop.counts.explored > 0 and loop.counts.saturated == loop.counts.explored


class Failing(RtiNmpc):
    """Fails at one call of `feedback`, like a solver."""

    calls = 0
    fails_at = 5

    def feedback(self, s, a=None):
        self.calls += 1
        if self.calls == self.fails_at:
            raise QpError("told to fail", status="failed")
        return super().feedback(s, a)


def test_a_failure_repeats_the_action_and_teaches_nothing(plant, problem, parameters):
    loop, _ = interaction(plant, problem, Failing(problem, parameters), exploration_probability=0.0)
    got = [loop.next()[0] for _ in range(10)]
    assert [sample is None for sample in got] == [False] * 3 + [True] * 2 + [False] * 5
    assert loop.counts.failures == 1


class Unprepared(RtiNmpc):
    """Has no finite QP after θ has moved."""

    def prepare_at(self, point):
        raise QpError("told to fail", status="QP not finite")


def test_a_theta_without_a_finite_qp_is_a_failed_solve(plant, problem, parameters):
    loop, _ = interaction(
        plant, problem, Unprepared(problem, parameters), exploration_probability=0.0
    )
    loop.next()
    loop.renew()
    assert loop.counts.failures == 1
    assert [loop.next()[0] is None for _ in range(3)] == [True, False, False]


def make_run(scenario, seed=3):
    configuration = QLearning.Configuration.from_dict({"prior_samples": 20, "step_every": 20})
    return TrainingRun("q-learning", scenario, 100, configuration, seed=seed)


def test_an_update_is_reported_where_theta_moves(plant):
    loop = begin_training(make_run(plant.scenario), QLearning, plant)
    for number in range(40):
        before = loop.controller.theta.copy()
        _, update = loop.advance()
        assert (update is not None) == (number % 20 == 19)
        assert np.array_equal(before, loop.controller.theta) == (update is None)
    assert not np.array_equal(loop.start_parameters.theta, loop.controller.theta)


def test_a_rule_that_rests_neither_moves_nor_explores(plant):
    run = dataclasses.replace(make_run(plant.scenario), rest_after=40)
    loop = begin_training(run, QLearning, plant)
    updates = [loop.advance()[1] for _ in range(40)]
    assert updates[-1] is not None
    theta, explored = loop.controller.theta.copy(), loop.counts.explored
    assert explored > 0
    assert [loop.advance()[1] for _ in range(40)] == [None] * 40
    np.testing.assert_array_equal(loop.controller.theta, theta)
    assert loop.counts.explored == explored


class Asking(QLearning):
    """Says on every fifth sample what it was told to say, and moves nothing."""

    requires = "operation"
    says: ClassVar = {}

    def observe(self, sample):
        if sample.number % 5 < 4:
            return None
        return Update(td_error=0.0, step=0.0, smallest_eigenvalue=1.0, **self.says)


class Privileged(Asking):
    requires = "simulator"


def asking(plant, base, **says):
    return begin_training(make_run(plant.scenario), type("Own", (base,), {"says": says}), plant)


def test_what_is_no_update_is_named(plant):
    returning_theta = {"observe": lambda rule, sample: np.zeros(3)}
    loop = begin_training(
        make_run(plant.scenario), type("Own", (QLearning,), returning_theta), plant
    )
    with pytest.raises(ConfigurationError, match="must return None or Update, got ndarray"):
        loop.advance()


def test_a_plant_in_operation_is_never_reset(plant):
    loop = asking(plant, Asking, episode=7)
    for _ in range(4):
        loop.advance()
    before = plant.time
    with pytest.raises(PrivilegeError) as caught:
        loop.advance()
    assert "\n" not in str(caught.value) and "episode" in str(caught.value)
    assert plant.time > before


def test_a_first_episode_is_a_simulators_too(plant):
    with pytest.raises(PrivilegeError):
        begin_training(
            make_run(plant.scenario), type("Own", (Asking,), {"first_episode": 3}), plant
        )
    begin_training(
        make_run(plant.scenario), type("Own", (Privileged,), {"first_episode": 3}), plant
    )
    first = plant.reset(3), plant.step(plant.scenario.reference_action).s
    assert np.array_equal(first[0], plant.scenario.initial_state)


def test_a_simulator_is_reset(plant):
    loop = asking(plant, Privileged, episode=7)
    for _ in range(5):
        loop.advance()
    assert np.array_equal(loop.s, plant.scenario.initial_state) and plant.time == 0.0


def reachable(root):
    """All objects that attributes, items and bound methods lead to."""
    seen, todo = {}, [root]
    while todo:
        item = todo.pop()
        if id(item) in seen or isinstance(item, type | ModuleType):
            continue
        seen[id(item)] = item
        todo += vars(item).values() if hasattr(item, "__dict__") else []
        todo += item.values() if isinstance(item, dict) else []
        todo += item if isinstance(item, list | tuple | set) else []
        todo += [item.__self__] if hasattr(item, "__self__") else []
    return seen.values()


def test_nothing_of_a_plant_in_operation_but_its_samples_can_be_had(plant):
    loop = asking(plant, Asking)
    for held in (loop, loop.algorithm):
        assert not any(isinstance(item, FmuPlant) for item in reachable(held))
    left = {name for name in dir(PlantInOperation(plant)) if not name.startswith("_")}
    assert left == {"scenario", "step"}
    assert any(isinstance(item, FmuPlant) for item in reachable(asking(plant, Privileged)))


def test_a_plant_in_operation_is_started_once_even_through_checkpoints(scenario, monkeypatch):
    resets = []
    reset = FmuPlant.reset

    def counted(self, seed):
        resets.append(seed)
        return reset(self, seed)

    monkeypatch.setattr(FmuPlant, "reset", counted)
    run = dataclasses.replace(
        make_run(scenario), log_every=20, evaluate_every=20, checkpoint_every=20,
        evaluation_seeds=1, evaluation_steps=5,
    )  # fmt: skip
    run_training(run, rule=Asking)
    judged = spawn_seeds(HELD_OUT)[0]
    assert [seed for seed in resets if seed != judged] == [spawn_seeds(run.seed)[0]]
