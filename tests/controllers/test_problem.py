import numpy as np
import pytest

from controllers.errors import ModelError
from controllers.problem import load_model
from tests.helpers.sampling import evaporator_problem

BAD = {
    "short bound": {"state_lower": [25]},
    "bound not finite": {"action_upper": [400, np.inf]},
    "text": {"reference_action": "u_s"},
    "crossed states": {"state_lower": [25, 80]},
    "no linear penalty": {"penalty_linear": [0, 1]},
    "no horizon": {"horizon": 0},
    "discount above one": {"discount": 1.01},
    "endless time": {"sampling_time": np.inf},
    "no steps": {"substeps": 0},
    "no cost": {"reference_cost": np.nan},
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_value_has_one_clear_error(case):
    with pytest.raises(ModelError):
        evaporator_problem(**BAD[case])


def test_penalty_is_linear_plus_quadratic_in_the_violation():
    problem = evaporator_problem(penalty_quadratic=[1, 3])
    assert problem.penalty([25.0, 80.0]) == 0.0
    assert problem.penalty([24.5, 83.0]) == 1e5 * 0.5 + 0.25 + 1e5 * 3 + 3 * 9


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
    with pytest.raises(ModelError):
        load_model(name)
