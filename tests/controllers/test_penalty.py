import casadi as ca
import numpy as np
import pytest

from controllers.penalty import StatePenalty

PENALTY = StatePenalty(
    np.array([25.0, 40.0]), np.array([100.0, 80.0]), np.array([10.0, 3.0]), np.array([2.0, 0.5])
)


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ((25.0, 80.0), 0.0),
        ((24.0, 60.0), 10.0 + 2.0),
        ((102.0, 39.0), 10.0 * 2 + 2.0 * 4 + 3.0 + 0.5),
    ],
)
def test_both_forms_are_linear_plus_quadratic_in_each_violation(state, expected):
    x = ca.SX.sym("x", 2)
    symbolic = ca.Function("p", [x], [PENALTY.symbolic(x)])
    assert PENALTY(state) == expected
    assert float(symbolic(state)) == pytest.approx(expected, rel=1e-15)
