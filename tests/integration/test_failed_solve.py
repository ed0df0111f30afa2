"""A solve that fails has the same consequence in every closed loop of the product.

The last action is applied once more, the guess is forgotten, and the next sample is solved from the
reference. The loops: Python's, interpreted and compiled; the compiled one; a training's; a rollout
on an empirical model, in Python and in C; the search of a back-off on the controller's own model;
the exported controller.
"""

import subprocess

import numpy as np
import pytest

from controllers import Parameters, Problem, RtiNmpc, functions
from controllers.export import core, plain_c
from cosim import FmuPlant, Scenario, simulate, train
from cosim.core.simulation import spawn_seeds
from learning import backed_off
from learning.empirical_model import EmpiricalModel, Features
from learning.rollout import Rollout
from tests.helpers.compiler import needs_compiler

SAMPLES, SEED = 70, 0


@pytest.fixture(scope="module")
def scenario():
    return Scenario.load("paper").replace(
        {"controller": {"model": "tests.helpers.limited:model", "horizon": 4}}
    )


@pytest.fixture(scope="module")
def problem(scenario):
    return Problem.from_scenario(scenario)


@pytest.fixture
def compiling(monkeypatch):
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    # Without contraction every level gives the same digits, and this one in a tenth of the time.
    monkeypatch.setattr(functions, "FLAGS", ("-O0", *functions.FLAGS[1:]))


class Rule:
    """The rule of a failed solve, in a loop of this test's own."""

    def __init__(self, problem, parameters=None):
        self.problem = problem
        parameters = Parameters.naive(problem) if parameters is None else parameters
        self.controller = RtiNmpc(problem, parameters)
        self.applied, self.failures = problem.reference_action, []

    def __call__(self, s):
        """Action (m,) for a state (n,)."""
        try:
            self.controller.prepare()
            action = self.controller.feedback(s).action
        except Exception as error:
            assert getattr(type(error), "is_solver_failure", False)
            self.failures.append(True)
            self.controller.reset()
        else:
            self.failures.append(False)
            self.applied = np.clip(action, self.problem.action_lower, self.problem.action_upper)
        return self.applied


def in_operation(scenario, rule):
    """States and actions of the rule on the plant, and the mean cost."""
    states, actions, costs = [], [], []
    with FmuPlant(scenario) as plant:
        s = plant.reset(spawn_seeds(SEED)[0])
        for _ in range(SAMPLES):
            a = rule(s)
            step = plant.step(a)
            states.append(s)
            actions.append(a)
            costs.append(step.stage_cost + step.penalty)
            s = step.s
    return np.array(states), np.array(actions), float(np.mean(costs))


@pytest.fixture(scope="module")
def expected(scenario, problem):
    """States, actions and failures; some samples fail, and the controller comes back."""
    rule = Rule(problem)
    states, actions, cost = in_operation(scenario, rule)
    failures = np.array(rule.failures)
    assert 5 < failures.sum() < SAMPLES - 5
    assert not (failures[1:] & failures[:-1]).any(), "a reset is what makes the next one succeed"
    return states, actions, failures, cost


def of_run(run):
    states = np.stack([run[name] for name in run.scenario.plant.states], axis=1)
    actions = np.stack([run[name] for name in run.scenario.plant.actions], axis=1)
    return states, actions, run["failed"].astype(bool)


def assert_same(found, expected):
    for got, wanted in zip(found, expected, strict=False):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-7)


def test_the_interpreted_loop(scenario, problem, expected):
    with FmuPlant(scenario) as plant:
        controller = RtiNmpc(problem, Parameters.naive(problem))
        run = simulate(plant, controller, SAMPLES, SEED)
    assert_same(of_run(run), expected)
    assert [status == "solved" for status in run.status] == (~expected[2]).tolist()


@needs_compiler
@pytest.mark.parametrize("loop", ["Python's", "its own"])
def test_the_compiled_controller(scenario, problem, expected, compiling, monkeypatch, loop):
    controller = RtiNmpc(problem, Parameters.naive(problem))
    controller.compile()
    assert controller.functions == "compiled"
    if loop == "Python's":
        monkeypatch.setattr(RtiNmpc, "compiled_loop", lambda self, scenario: None)
    with FmuPlant(scenario) as plant:
        run = simulate(plant, controller, SAMPLES, SEED)
    assert_same(of_run(run), expected)
    assert [status == "solved" for status in run.status] == (~expected[2]).tolist()


def test_a_training(scenario, problem):
    start = {"seed": SEED, "log_every": SAMPLES, "evaluate_every": SAMPLES}
    done = train("fixed", scenario, SAMPLES, evaluation_seeds=1, evaluation_steps=5, **start)
    rule = Rule(problem, done.start)
    _, _, cost = in_operation(scenario, rule)
    _, row = done.rows
    assert row["failures"] == sum(rule.failures) > 5
    assert row["J"] == pytest.approx(cost, rel=1e-9)


@pytest.fixture
def fitted():
    """The evaporator's own model as an empirical one: the plant knows no limit."""
    features = Features(Problem.from_scenario(Scenario.load("paper")))
    size = features.n_parameters + features.n_outputs * (1 + features.n_inputs)
    return EmpiricalModel(
        features=features,
        centre=np.zeros(features.n_inputs),
        unit=np.ones(features.n_inputs),
        mean=np.zeros(size),
        covariance=np.zeros((size, size)),
        residuals=np.random.default_rng(1).uniform(-0.4, 0.4, (200, features.n_outputs)),
        persistence=np.zeros((features.n_outputs, features.n_outputs)),
    )


@pytest.mark.parametrize(
    "language", ["Python", pytest.param("C", marks=[needs_compiler, pytest.mark.slow])]
)
def test_a_rollout_on_an_empirical_model(problem, fitted, request, language):
    request.getfixturevalue("interpreted" if language == "Python" else "compiling")
    parameters = Parameters.naive(problem)
    rollout = Rollout(problem, parameters, fitted.features)
    assert (rollout.compiled is not None) == (language == "C")
    picks = np.arange(SAMPLES, dtype=np.int32)
    start = problem.reference_state + np.array([1.0, 0.2])
    ((inputs, _, _),) = rollout([parameters.theta], start, fitted, picks)
    rule, s = Rule(problem), start
    for k in range(SAMPLES):
        a = rule(s)
        np.testing.assert_allclose(inputs[k], np.concatenate([s, a]), rtol=0, atol=1e-6)
        predicted, h, _ = fitted.predict(inputs[k : k + 1])
        s = (predicted[0] + h[0] * fitted.residuals[picks[k]])[:-1]
    assert 3 < sum(rule.failures) < SAMPLES - 3


def test_the_search_of_a_back_off(scenario, problem, monkeypatch):
    transitions = []

    class FirstSegment(backed_off.BackOffSearch):
        """Keeps its samples, and ends."""

        def observe(self, transition):
            transitions.append(transition)
            self.has_ended = len(transitions) == SAMPLES
            return self.has_ended

    # The plant knows no limit.
    plant = backed_off.GuessedPlant(Scenario.load("paper"), 0.1)
    monkeypatch.setattr(backed_off, "BackOffSearch", FirstSegment)
    monkeypatch.setattr(backed_off, "GuessedPlant", lambda scenario, deviation: plant)
    parameters = Parameters.naive(problem)
    backed_off.back_off(parameters, scenario)
    seed = int(np.random.default_rng(0).integers(2**63, size=12)[0])
    rule, s = Rule(problem, parameters), plant.reset(seed)
    for transition in transitions:
        a = rule(s)
        if transition is not None:
            np.testing.assert_array_equal(transition.s, s)
            np.testing.assert_array_equal(transition.a, a)
        s = plant.step(a).s
    assert [transition is None for transition in transitions] == rule.failures
    assert 5 < sum(rule.failures) < SAMPLES - 5


@pytest.mark.slow
@needs_compiler
def test_the_exported_controller(scenario, problem, expected, tmp_path):
    exported = core(problem, Parameters.naive(problem))
    for name, text in plain_c(exported, "limited", scenario).items():
        (tmp_path / name).write_text(text)
    program = tmp_path / "program"
    command = ["cc", "-std=c99", "-O0", "-ffp-contract=off", "limited.c", "main.c"]
    subprocess.run([*command, "-o", program, "-lm"], cwd=tmp_path, check=True)
    states, actions, failures, _ = expected
    text = "\n".join(" ".join(map(repr, s)) for s in states.tolist())
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    found = np.array([list(map(float, line.split())) for line in done.stdout.splitlines()])
    np.testing.assert_allclose(found[:, :2], actions, rtol=0, atol=1e-7)
    assert (found[:, 2] != 0).tolist() == failures.tolist()
