import re
import types
from dataclasses import replace

import numpy as np
import pytest

from controllers import Problem
from controllers.errors import ModelError
from controllers.problem import load_model
from tests.helpers.sampling import evaporator_problem

BAD = {
    "short bound": ({"state_lower": [25]}, "state_lower must be 2 finite numbers"),
    "bound not finite": ({"action_upper": [400, np.inf]}, "action_upper must be 2 finite numbers"),
    "reference not finite": ({"reference_state": [np.nan, 1]}, "reference_state must be 2 finite"),
    "text": ({"reference_action": "u_s"}, "reference_action holds no numbers: 'u_s'"),
    "crossed states": ({"state_lower": [25, 80]}, "state_lower must be below state_upper"),
    "crossed actions": ({"action_upper": [100, 400]}, "action_lower must be below action_upper"),
    "no linear penalty": ({"penalty_linear": [0, 1]}, "must be positive"),
    "no quadratic penalty": ({"penalty_quadratic": [1, -1]}, "must be positive"),
    "no horizon": ({"horizon": 0}, "horizon 0 must be at least 1"),
    "no discount": ({"discount": 0.0}, r"discount 0.0 in \(0, 1\]"),
    "discount above one": ({"discount": 1.01}, r"discount 1.01 in \(0, 1\]"),
    "discount not a number": ({"discount": np.nan}, "discount nan"),
    "no time": ({"sampling_time": 0.0}, "sampling_time 0.0 s must be positive"),
    "endless time": ({"sampling_time": np.inf}, "sampling_time inf s must be positive and finite"),
    "no steps": ({"substeps": 0}, "substeps 0 at least 1"),
    "no cost": ({"reference_cost": np.nan}, "reference_cost must be finite"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_value_has_one_clear_error(case):
    changes, message = BAD[case]
    with pytest.raises(ModelError, match=f"problem: .*{message}"):
        evaporator_problem(**changes)


def test_arrays_are_frozen_copies():
    bound = np.array([25.0, 40.0])
    problem = evaporator_problem(state_lower=bound)
    bound[0] = 0.0
    assert problem.state_lower[0] == 25.0
    with pytest.raises(ValueError, match="read-only"):
        problem.state_lower[0] = 1.0


def test_penalty_is_linear_plus_quadratic_in_the_violation():
    problem = evaporator_problem(penalty_quadratic=[1, 3])
    assert problem.penalty([25.0, 80.0]) == 0.0
    assert problem.penalty([24.5, 83.0]) == 1e5 * 0.5 + 0.25 + 1e5 * 3 + 3 * 9


def test_a_scenario_is_read_field_by_field(problem):
    settings = types.SimpleNamespace(
        model="controllers.evaporator:model",
        horizon=7,
        substeps=3,
        reference_state=problem.reference_state,
        reference_action=problem.reference_action,
        reference_cost=1.5,
    )
    names = ("sampling_time", "discount", "state_lower", "state_upper", "action_lower",
             "action_upper", "penalty_linear", "penalty_quadratic")  # fmt: skip
    scenario = types.SimpleNamespace(
        controller=settings, **{name: getattr(problem, name) for name in names}
    )
    read = Problem.from_scenario(scenario)
    assert (read.horizon, read.substeps, read.reference_cost) == (7, 3, 1.5)
    assert read.model.name == "evaporator"
    for name in names:
        np.testing.assert_array_equal(getattr(read, name), getattr(problem, name))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("controllers.nowhere:model", "No module named"),
        ("controllers.evaporator:nothing", "no attribute 'nothing'"),
        ("controllers.evaporator", "name it as module:factory"),
        ("", "name it as module:factory"),
        ("controllers.evaporator:STATES", "not callable"),
        ("builtins:dict", "returned dict, not a controllers.Model"),
    ],
)
def test_a_model_that_cannot_be_had_is_named(name, message):
    with pytest.raises(ModelError, match=f"model '{re.escape(name)}' .*{message}"):
        load_model(name)


def test_a_scenario_without_a_model_says_which_line_is_missing():
    with pytest.raises(
        ModelError, match=r'names no model .* model = "module:factory" .*\[controller\]'
    ):
        load_model(None)


def test_replacing_a_field_checks_again(problem):
    with pytest.raises(ModelError, match="horizon"):
        replace(problem, horizon=-1)
