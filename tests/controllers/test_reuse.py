"""What controllers of one problem share: functions of equal content, never a memory."""

import dataclasses

import casadi as ca
import numpy as np
import pytest

from controllers import Parameters, Problem, RtiNmpc
from controllers.preparation import preparation_definition
from controllers.problem import VECTORS
from cosim import Scenario
from tests.helpers.models import root_finder

RATES = [0.9, 1.0, 1.1]


@pytest.fixture(scope="module")
def problem():
    return Problem.from_scenario(Scenario.load("paper"))


def table(slope):
    return ca.interpolant("table", "linear", [np.arange(4.0)], slope * np.arange(4.0))


def actions(controllers, states):
    """Actions of each controller, which take turns at every state."""
    seen = [[] for _ in controllers]
    for s in states:
        for controller, taken in zip(controllers, seen, strict=True):
            controller.prepare()
            taken.append(controller.feedback(s).action.tobytes())
    return seen


def test_two_controllers_of_one_problem_share_functions_and_no_memory(problem):
    again = Problem.from_scenario(Scenario.load("paper"))
    naive = Parameters.naive(problem)
    other = naive.replace({"x_l": naive["x_l"] + 1.0})
    states = problem.reference_state + np.random.default_rng(0).normal(0, 1, (6, 2))
    alone = [actions([RtiNmpc(problem, theta)], states)[0] for theta in (naive, other)]
    in_turns = actions([RtiNmpc(problem, naive), RtiNmpc(again, other)], states)
    assert in_turns == alone
    assert alone[0] != alone[1]
    blocks = naive.blocks
    shared = preparation_definition(problem, blocks), preparation_definition(again, blocks)
    assert shared[0] is shared[1]


@pytest.mark.parametrize("name", [*VECTORS, "sampling_time", "discount", "reference_cost"])
def test_a_number_that_differs_in_its_last_digit_is_another_content(problem, name):
    value = np.array(getattr(problem, name), dtype=float)
    first = (0,) * value.ndim
    value[first] = np.nextafter(value[first], -np.inf)
    changed = value if value.ndim else float(value)
    assert dataclasses.replace(problem, **{name: changed}).content != problem.content


def with_rate(problem, change):
    model = problem.model
    ode = model.ode
    changed = dataclasses.replace(model, ode=lambda x, u, d, p: change(ode(x, u, d, p)))
    return dataclasses.replace(problem, model=changed)


def test_a_closure_is_known_by_what_it_computes(problem):
    contents = {with_rate(problem, lambda rate, by=by: by * rate).content for by in RATES}
    assert len(contents) == len(RATES)
    assert with_rate(problem, lambda rate: 0.9 * rate).content in contents


def test_tables_are_content_and_what_casadi_does_not_hold_is_never_reused(problem):
    def content(function):
        return with_rate(problem, lambda rate: rate + function(rate[0])).content

    assert content(table(1.0)) == content(table(1.0)) != content(table(2.0))
    # A root finder may call anything: what it computes is not in the model.
    root = root_finder()
    assert content(lambda x: root(0.0, x)) != content(lambda x: root(0.0, x))
