import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.penalty import Penalty

PENALTY = Penalty([25, 40], [100, 80], [1e5, 2e5], [1.0, 3.0])


def test_is_zero_on_and_within_the_bounds():
    for state in ([25.0, 40.0], [100.0, 80.0], [50.0, 60.0]):
        assert PENALTY(state) == 0.0


def test_is_linear_plus_quadratic_in_each_violation():
    assert PENALTY([24.5, 83.0]) == 1e5 * 0.5 + 1.0 * 0.25 + 2e5 * 3.0 + 3.0 * 9.0


@given(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)))
def test_agrees_with_the_formula_over_violations(state):
    v = PENALTY.violation(np.array(state))
    assert (v >= 0).all()
    expected = PENALTY.linear @ v + PENALTY.quadratic @ v**2
    assert PENALTY(list(state)) == pytest.approx(expected, rel=1e-14, abs=0)


def test_violation_takes_whole_trajectories():
    states = np.array([[24.0, 81.0], [25.0, 39.0], [30.0, 50.0]])
    np.testing.assert_array_equal(PENALTY.violation(states), [[1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])


def test_a_nan_state_has_a_nan_penalty():
    assert np.isnan(PENALTY([float("nan"), 50.0]))
