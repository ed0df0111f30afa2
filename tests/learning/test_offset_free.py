"""Offset-free control: its runs, and its back-off by prediction errors made by hand."""

import numpy as np
import pytest

from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim import FmuPlant, simulate
from learning.log import to_csv
from learning.offset_free import OffsetFree
from learning.prediction_errors import OneStepModel
from learning.training import run_training
from learning.training_run import begin_training
from tests.helpers import training
from tests.helpers.training import Carrier, bare_transition, killed_and_resumed

MEMORY = 40


def make_run(scenario="paper", settings=None, **changes):
    values = {"samples": 450, "seed": 3, "start": "tuned", "evaluation_steps": 20}
    every = {"log_every": 50, "evaluate_every": 450, "checkpoint_every": 50}
    settings = settings or {"memory": 100}
    return training.make_run("offset-free", scenario, settings, **{**values, **every, **changes})


@pytest.mark.slow
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(tmp_path):
    run = make_run()
    whole = run_training(run)
    resumed = killed_and_resumed(run, tmp_path, 250)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert (whole.plant_samples, whole.status) == (450, "finished")


def test_it_predicts_without_bias_under_a_wrong_model():
    run = make_run("fouled", {"back_off": False}, samples=600)
    theta = run_training(run).parameters
    problem = Problem.from_scenario(run.scenario)
    assert np.array_equal(theta["x_l"], problem.state_lower), "no back-off was asked for"
    with FmuPlant(run.scenario) as plant:
        seen = simulate(plant, RtiNmpc(problem, theta), 300, 11)
    model, naive = OneStepModel(run.scenario), Parameters.naive(problem)
    parts = seen.states[:-1], seen.actions[:-1], seen.states[1:]
    before, after = (model.errors(*parts, other).mean(axis=0) for other in (naive, theta))
    assert abs(after[1]) < 0.1 * abs(before[1])


def test_it_goes_on_and_backs_off_by_its_own_errors():
    run = make_run("fouled", samples=1400)
    with FmuPlant(run.scenario) as plant:
        loop, moved, bounds = begin_training(run, OffsetFree, plant), [], []
        for sample in range(1400):
            if loop.advance()[1] is not None:
                moved.append(sample)
                bounds.append([loop.parameters["x_l"][0], loop.parameters["x_u"][1]])
    lower, upper = np.array(bounds).T
    assert moved[-1] == 1399 and len(moved) == 140
    assert (lower > 25.5).sum() > len(lower) / 2 and (upper < 80.0).any()
    assert (lower >= 25.0).all() and (upper <= 80.0).all()


@pytest.fixture(scope="module")
def predict(scenario, problem):
    model, nominal = OneStepModel(scenario), problem.model.nominal_parameters
    return lambda s, a: model.predict(s, a, nominal)[0]


@pytest.fixture
def fed(scenario, problem, parameters, predict):
    """Give θ, (update by update), of offset-free control that meets given prediction errors."""

    def feed(errors, start=parameters, **settings):
        settings = {"memory": MEMORY, "update_every": 1, **settings}
        configuration = OffsetFree.Configuration.from_dict(settings)
        controller, rng = Carrier(start), np.random.default_rng(0)
        rule = OffsetFree(controller, scenario, configuration, len(errors), None, rng)
        s, a, seen = problem.reference_state, problem.reference_action, []
        expected = predict(s, a)
        for number, error in enumerate(errors):
            rule.observe(bare_transition(number, s, a, 1.0, expected + error))
            seen.append(controller.parameters)
        return seen

    return feed


def test_the_offset_is_a_running_mean_at_first_and_forgets_exponentially_from_then_on(fed):
    """c ← c + (e − c)/min(k, memory): after a step of d it is d (1 − (1 − 1/memory)ᴷ) of it."""
    d, later = np.array([0.4, -0.6]), 60
    errors = np.concatenate([np.zeros((3 * MEMORY, 2)), np.tile(d, (later, 1))])
    offset = fed(errors)[-1]["c_f"]
    assert offset == pytest.approx(d * (1 - (1 - 1 / MEMORY) ** later))


def test_of_fewer_errors_than_the_memory_the_offset_is_their_mean(fed, rng):
    errors = rng.normal(0.0, 0.3, (MEMORY - 1, 2))
    for k, theta in enumerate(fed(errors), start=1):
        assert theta["c_f"] == pytest.approx(errors[:k].mean(axis=0))


def test_a_bound_stands_back_by_the_error_that_would_have_led_beyond_it(fed, scenario):
    """Lower bounds rise by the most negative error about the offset, upper ones fall."""
    errors = np.zeros((MEMORY, 2))
    errors[3], errors[7], errors[20], errors[21] = [-0.7, 0.0], [0.5, 0.0], [0.0, -1.0], [0.0, 2.0]
    theta = fed(errors)[-1]
    offset = errors.mean(axis=0)
    assert theta["x_l"] - scenario.state_lower == pytest.approx([0.7 + offset[0], 1.0 + offset[1]])
    assert scenario.state_upper - theta["x_u"] == pytest.approx([0.5 - offset[0], 2.0 - offset[1]])


def test_the_back_off_forgets_the_errors_that_its_memory_has_lost(fed, scenario):
    errors = np.zeros((3 * MEMORY, 2))
    errors[:10, 0] = -0.7
    theta = fed(errors)[-1]
    assert theta["x_l"][0] - scenario.state_lower[0] < 0.2


def test_with_few_errors_the_starts_back_off_is_kept(fed, scenario, parameters):
    start = parameters.replace({"x_l": parameters["x_l"] + [1.5, 0.0]})
    few = fed(np.zeros((MEMORY - 1, 2)), start)[-1]
    assert few["x_l"][0] - scenario.state_lower[0] == pytest.approx(1.5)
    enough = fed(np.zeros((MEMORY, 2)), start)[-1]
    assert enough["x_l"][0] == pytest.approx(scenario.state_lower[0])


def test_without_back_off_only_the_offset_moves(fed, parameters):
    theta = fed(np.full((MEMORY, 2), 0.3), back_off=False)[-1]
    moved = {
        name
        for name in ("c_f", "x_l", "x_u", "B_l", "b_l", "B_Vf", "b_Vf", "c_lambda")
        if not np.array_equal(theta[name], parameters[name])
    }
    assert moved == {"c_f"}
