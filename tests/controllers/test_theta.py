import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controllers import ThetaBlocks
from controllers.errors import ParameterError
from controllers.theta import ThetaBlock

FINITE = st.floats(allow_nan=False, allow_infinity=False)
MATRIX = ThetaBlock("B", (3, 3), (1.0,) * 6)


def test_the_papers_theta_has_its_blocks_in_order(problem):
    blocks = ThetaBlocks.of(problem)
    assert list(blocks.slices) == [
        "B_lambda", "b_lambda", "c_lambda", "B_Vf", "b_Vf", "B_l", "b_l", "c_f", "x_l", "x_u",
    ]  # fmt: skip
    assert blocks.size == 3 + 2 + 1 + 3 + 2 + 10 + 4 + 2 + 2 + 2


@given(st.lists(FINITE, min_size=6, max_size=6))
def test_packing_undoes_unpacking_bit_for_bit(entries):
    packed = np.array(entries)
    assert MATRIX.pack(MATRIX.unpack(packed)).tobytes() == packed.tobytes()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([[1.0, 2.0], [2.0, 1.0]], r"shape \(2, 2\); it must have \(3, 3\)"),
        ([[1, 0, 0], [0, 1, 0], [1e-9, 0, 1]], "must be symmetric"),
        ([[np.nan, 0, 0], [0, 1, 0], [0, 0, 1]], "not finite"),
        ([[1, 0, 0], [0, np.inf, 0], [0, 0, 1]], "not finite"),
        ([[1, 0], [0, 1, 0]], "holds no float64 numbers"),
        ("identity", "holds no float64 numbers"),
        ({"a": 1}, "holds no float64 numbers"),
        (10**400, "holds no float64 numbers"),
        (
            [[True, False, False], [False, True, False], [False, False, True]],
            "holds no float64 numbers",
        ),
    ],
)
def test_a_bad_value_is_refused_with_the_block_named(value, message):
    with pytest.raises(ParameterError):
        MATRIX.pack(value)


def test_model_parameters_scale_with_their_nominal_value(problem):
    blocks = ThetaBlocks.of(problem, model_parameters=("UA2", "h"))
    np.testing.assert_allclose(blocks.scale[blocks.slices["p"]], [0.684, 0.016])
