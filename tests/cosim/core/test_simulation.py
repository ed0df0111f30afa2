import time

import numpy as np
import pytest

from controllers import compile_functions
from controllers.factories import build_controller
from cosim import FmuPlant, Scenario, simulate
from cosim.core import simulation
from cosim.core.errors import PlantError, RunEndedError
from cosim.core.simulation import PART, functions_of, indicators, input_effort, spawn_seeds
from cosim.core.trajectory import FALLBACK
from tests.helpers.loop import Failing, Hold, Proportional


@pytest.fixture
def evaporator(paper):
    with FmuPlant(paper) as plant:
        yield plant


def same(one, other):
    return all(
        one[name].tobytes() == other[name].tobytes() for name in one.signals
    ) and list(one.status) == list(other.status)  # fmt: skip


def test_a_run_is_what_the_plant_does_under_the_controllers_actions(evaporator, paper):
    trajectory = simulate(evaporator, Proportional(paper), 50, seed=3)
    controller = Proportional(paper)
    s = evaporator.reset(spawn_seeds(3)[0])
    for k in range(50):
        action = np.clip(controller.feedback(s).action, paper.action_lower, paper.action_upper)
        np.testing.assert_array_equal(trajectory.states[k], s)
        np.testing.assert_array_equal(trajectory.actions[k], action)
        step = evaporator.step(action)
        np.testing.assert_array_equal(trajectory.disturbances[k], step.disturbance)
        assert trajectory["stage_cost"][k] == step.stage_cost
        assert trajectory["penalty"][k] == step.penalty
        assert trajectory["value"][k] == controller.feedback(s).value
        s = step.s
    np.testing.assert_array_equal(trajectory.final_state, s)


def test_sampling_instants_are_multiples_of_the_sampling_time():
    with FmuPlant(Scenario.load("paper").replace({"sampling_time": 0.1})) as plant:
        trajectory = simulate(plant, Proportional(plant.scenario), 1000, seed=0)
    np.testing.assert_array_equal(trajectory.time, np.arange(1000) * 0.1)


def test_actuators_saturate_what_a_controller_asks_for(evaporator, paper):
    trajectory = simulate(evaporator, Hold([1000.0, -5.0]), 10, seed=0)
    np.testing.assert_array_equal(trajectory.actions, np.tile([400.0, 100.0], (10, 1)))


@pytest.mark.parametrize("phase", ["prepare", "feedback"])
def test_a_failed_solve_repeats_the_last_action_and_is_counted(evaporator, paper, phase):
    controller = Failing(paper, at=[0, 7, 8], phase=phase)
    trajectory = simulate(evaporator, controller, 20, seed=6)
    np.testing.assert_array_equal(trajectory.actions[0], paper.reference_action)
    np.testing.assert_array_equal(trajectory.actions[7], trajectory.actions[6])
    np.testing.assert_array_equal(trajectory.actions[8], trajectory.actions[6])
    assert not np.array_equal(trajectory.actions[6], trajectory.actions[9])
    assert np.flatnonzero(trajectory["failed"]).tolist() == [0, 7, 8]
    assert [k for k, word in enumerate(trajectory.status) if word == FALLBACK] == [0, 7, 8]
    assert np.isnan(trajectory["value"][[0, 7, 8]]).all()
    summary = trajectory.summary()
    assert summary["failures"] == 3
    assert summary["statuses"] == {"fallback": 3, "solved": 17}
    assert controller.resets == 1 + 3


def test_residuals_that_nobody_wants_are_not_computed(evaporator, paper):
    whole = simulate(evaporator, Proportional(paper), 20, seed=1)
    spared = simulate(evaporator, Proportional(paper), 20, seed=1, residuals=False)
    assert np.isnan(spared["residual"]).all()
    for name in whole.signals.keys() - {"residual"}:
        assert whole[name].tobytes() == spared[name].tobytes()


class Recorder:
    """Keeps copies of what it is given."""

    def __init__(self, fail_at=None):
        self.calls, self.blocks, self._fail_at = [], [], fail_at

    def start(self, scenario, controller, seed, steps, units):
        self.calls.append(("start", scenario.name, controller.name, seed, steps, units["P2"]))

    def record(self, first, columns, status):
        if first == self._fail_at:
            raise OSError("disk full")
        self.blocks.append((first, columns["states"].copy(), list(status), columns))

    def close(self):
        self.calls.append(("close",))


class Predicting(Proportional):
    """Gives a prediction with every second solution."""

    def feedback(self, s, a=None):
        answer = super().feedback(s)
        if s[0] <= 25.0:
            return answer
        states, actions = np.tile(s, (4, 1)), np.tile(answer.action, (3, 1))
        return answer._replace(predicted_states=states, predicted_actions=actions)


def test_a_recorder_gets_the_whole_run_in_parts(evaporator, paper):
    recorder, done, steps = Recorder(), [], 2 * PART + 17
    trajectory = simulate(
        evaporator, Predicting(paper), steps, seed=9, recorder=recorder, progress=done.append
    )
    assert recorder.calls == [("start", "paper", "proportional", 9, steps, "kPa"), ("close",)]
    assert [first for first, *_ in recorder.blocks] == [0, PART, 2 * PART]
    assert done == [PART, 2 * PART, steps]
    states = np.concatenate([states for _, states, *_ in recorder.blocks])
    np.testing.assert_array_equal(states, trajectory.states)
    for _, states, status, block in recorder.blocks:
        assert len(status) == len(states) == len(block["predicted_states"])
        predicted, stages = states[:, 0] > 25.0, block["predicted_states"]
        np.testing.assert_array_equal(stages[predicted][:, 3], states[predicted])
        assert np.isnan(stages[~predicted]).all()
        assert block["predicted_actions"].shape[1:] == (3, 2)


def test_recording_does_not_change_the_run_nor_do_longer_parts(evaporator, paper, monkeypatch):
    plain, recorder = simulate(evaporator, Predicting(paper), 600, seed=9), Recorder()
    monkeypatch.setattr("cosim.core.simulation.PART", 2)
    assert same(plain, simulate(evaporator, Predicting(paper), 600, seed=9, recorder=recorder))
    assert [first for first, *_ in recorder.blocks] == [*range(0, 600, 600 // 200)]


def test_the_recorder_is_closed_when_the_run_fails(evaporator, paper):
    recorder = Recorder(fail_at=PART)
    with pytest.raises(OSError, match="disk full"):
        simulate(evaporator, Proportional(paper), 2 * PART, seed=0, recorder=recorder)
    assert (recorder.calls[-1], len(recorder.blocks)) == (("close",), 1)


def test_input_effort_is_the_share_of_the_range_moved_per_sample():
    actions = np.array([[100.0, 200.0], [130.0, 200.0], [130.0, 170.0]])
    effort = input_effort(actions, np.array([100.0, 100.0]), np.array([400.0, 400.0]))
    assert effort == pytest.approx((0.1 + 0.1) / 2)


def test_indicators_are_the_definitions_applied_to_the_signals(paper):
    with FmuPlant(paper) as plant:
        run = simulate(plant, Proportional(paper), 200, 3)
    found = indicators(run)
    violation = np.maximum(paper.state_lower - run.states, 0) + np.maximum(
        run.states - paper.state_upper, 0
    )
    penalty = (1e5 * violation + violation**2).sum(axis=1)
    assert found["mean_violation"] == pytest.approx(violation.sum(axis=1).mean(), rel=1e-12)
    assert found["violating_share"] == np.mean(violation.sum(axis=1) > 1e-6)
    assert found["J"] == pytest.approx(np.mean(run["stage_cost"] + penalty), rel=1e-12)
    assert found["economic_cost"] == pytest.approx(np.mean(run["stage_cost"]), rel=1e-12)
    assert found["failures"] == 0


def test_rounding_at_a_bound_is_no_violation_but_a_millionth_is(evaporator, paper):
    below = np.array([0.0, 1e-14, 1e-9, 9e-7, 1.1e-6, 1e-3])
    run = simulate(evaporator, Proportional(paper), 6, seed=0)
    run.signals["violation"].values[:] = below
    found = indicators(run)
    assert found["violating_share"] == 2 / 6
    assert found["mean_violation"] == pytest.approx(below.mean(), rel=1e-12)


def test_a_controller_that_rests_on_its_bound_does_not_violate_it():
    nominal = Scenario.load("nominal")
    with FmuPlant(nominal) as plant:
        run = simulate(plant, build_controller("tuned", nominal), 300, 0)
    assert np.mean(run["violation"] > 0) > 0.2, "rounds nowhere below the bound: proves nothing"
    assert indicators(run)["violating_share"] == 0.0


@pytest.mark.parametrize("compiled", [False, True])
def test_a_plant_that_fails_in_mid_run_leaves_the_samples_before(paper, compiled):
    """Seven samples, then the FMU says no: in either loop they are those of a run of seven."""

    class Ending(FmuPlant):
        def step(self, a):
            if self.k == 7:
                raise PlantError("out of water")
            return super().step(a)

        def drive(self, loop, table):
            for row in table:
                step = self.step(paper.reference_action)
                row[:] = [*paper.initial_state, *paper.reference_action, step.stage_cost,
                          *step.disturbance, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]  # fmt: skip
            return self.state

    class Compiled(Hold):
        def compiled_loop(self, scenario):
            return "a loop"

    law = (Compiled if compiled else Hold)(paper.reference_action)
    with FmuPlant(paper) as plant:
        expected = simulate(plant, Hold(paper.reference_action), 7, 0)
    with Ending(paper) as plant, pytest.raises(RunEndedError) as caught:
        simulate(plant, law, 10, 0)
    assert str(caught.value) == "out of water; the run ended after 7 of 10 samples"
    run = caught.value.trajectory
    assert len(run) == 7
    np.testing.assert_array_equal(run["stage_cost"], expected["stage_cost"])
    if not compiled:
        np.testing.assert_array_equal(run.states, expected.states)
        np.testing.assert_array_equal(run.final_state, expected.final_state)


@pytest.mark.parametrize(("steps", "functions"), [(20, "interpreted"), (1000, "compiled")])
def test_a_long_run_from_python_is_compiled_as_by_the_command(
    evaporator, paper, steps, functions, monkeypatch
):
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    nmpc = build_controller("naive", paper)
    run = simulate(evaporator, nmpc, steps, 0)
    assert functions_of(nmpc) == functions
    other = build_controller("naive", paper)
    compile_functions(other, steps)
    assert same(run, simulate(evaporator, other, steps, 0))


def test_a_controller_with_a_compile_of_its_own_is_left_alone(evaporator, paper):
    class Compiling(Proportional):
        def compile(self, samples):
            raise AssertionError("it was compiled")

    assert len(simulate(evaporator, Compiling(paper), 1000, 0)) == 1000


def test_a_slow_plant_reports_within_a_part(evaporator, paper, monkeypatch):
    monkeypatch.setattr(simulation, "PART_SECONDS", 0.01)
    step = FmuPlant.step

    def slow(plant, action):
        time.sleep(0.003)
        return step(plant, action)

    monkeypatch.setattr(FmuPlant, "step", slow)
    reported = []
    simulate(evaporator, Proportional(paper), 40, 0, progress=reported.append)
    assert len(reported) > 5
    assert reported == sorted(set(reported))
    assert reported[-1] == 40


def test_the_parts_of_a_slow_compiled_loop_do_not_change_its_digits(evaporator, paper, monkeypatch):
    quick = simulate(evaporator, build_controller("naive", paper), 1000, 0)
    monkeypatch.setattr(simulation, "PART_SECONDS", 1e-9)
    reported = []
    nmpc = build_controller("naive", paper)
    slow = simulate(evaporator, nmpc, 1000, 0, progress=reported.append)
    assert len(reported) > 900, "each part is of one sample in the end"
    assert same(quick, slow)
