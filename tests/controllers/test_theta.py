import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controllers import Parameters, ThetaBlocks
from controllers.errors import ParameterError
from controllers.theta import ThetaBlock
from tests.helpers.sampling import random_parameters

FINITE = st.floats(allow_nan=False, allow_infinity=False)
MATRIX = ThetaBlock("B", (3, 3), (1.0,) * 6)


def test_the_papers_theta_has_its_blocks_in_order(problem):
    blocks = ThetaBlocks.from_problem(problem)
    assert list(blocks.slices) == [
        "B_lambda", "b_lambda", "c_lambda", "B_Vf", "b_Vf", "B_l", "b_l", "c_f", "x_l", "x_u",
    ]  # fmt: skip
    assert blocks.size == 3 + 2 + 1 + 3 + 2 + 10 + 4 + 2 + 2 + 2


@given(st.lists(FINITE, min_size=6, max_size=6))
def test_packing_undoes_unpacking_bit_for_bit(entries):
    packed = np.array(entries)
    assert MATRIX.pack(MATRIX.unpack(packed)).tobytes() == packed.tobytes()


def test_model_parameters_scale_with_their_nominal_value(problem):
    blocks = ThetaBlocks.from_problem(problem, model_parameters=("UA2", "h"))
    np.testing.assert_allclose(blocks.scale[blocks.slices["p"]], [0.684, 0.016])


BLOCKS = {
    "paper": {},
    "extended": {"slack_weights": True},
    "physical": {"slack_weights": True, "model_parameters": ("UA2", "h")},
    "estimated": {"model_parameters": ("UA2",), "margin": True, "noise": ("a", "b")},
}


@pytest.fixture(params=BLOCKS)
def parameters(request, problem, rng):
    return random_parameters(
        problem, ThetaBlocks.from_problem(problem, **BLOCKS[request.param]), rng
    )


def test_naive_is_the_papers_guess(problem):
    theta = Parameters.naive(problem)
    np.testing.assert_array_equal(theta["B_l"], np.eye(4))
    np.testing.assert_array_equal(theta["B_Vf"], np.eye(2))
    np.testing.assert_array_equal(theta["x_l"], [25, 40])
    np.testing.assert_array_equal(theta["x_u"], [100, 80])
    assert theta["c_lambda"] == problem.reference_cost
    for name in ("B_lambda", "b_lambda", "b_Vf", "b_l", "c_f"):
        assert not theta[name].any()


# hash and file --------------------------------------------------------------------------------


def test_the_hash_tells_the_smallest_change(parameters):
    theta = parameters.theta.copy()
    theta[0] = np.nextafter(theta[0], np.inf)
    assert parameters.with_theta(theta).hash != parameters.hash
    assert parameters.with_theta(parameters.theta).hash == parameters.hash


def test_a_file_gives_back_the_same_bits(parameters, problem, tmp_path):
    awkward = parameters.theta * np.pi * 1e-300
    awkward[0], awkward[1] = -0.0, 5e-324
    written = parameters.with_theta(awkward)
    read = Parameters.load(written.save(tmp_path / "theta.toml"), problem)
    assert read.theta.tobytes() == written.theta.tobytes()
    assert read.blocks == written.blocks
    assert read.hash == written.hash


def edited(text, pattern, replacement):
    changed, count = re.subn(pattern, replacement, text, flags=re.S | re.M)
    assert count, f"the test's pattern {pattern} does not occur"
    return changed


BAD = {
    "no toml": (r"\A", "= "),
    "another schema": (r"^schema = 1", "schema = 2"),
    "key unknown": (r"\A", "model_parameter = ['h']\n"),
    "block missing": (r"^b_Vf = \[.*?\]\n", ""),
    "block unknown": (r"^b_Vf = ", "b_f = "),
    "half of the slack weights": (r"^w_sigma = \[.*?\]\n", ""),
    "wrong size": (r"^c_f = \[", "c_f = [1.0,"),
    "text": (r"^c_lambda = .*?$", 'c_lambda = "much"'),
    "huge": (r"^c_lambda = .*?$", "c_lambda = 1" + 400 * "0"),
    "not a number": (r"^c_lambda = .*?$", "c_lambda = nan"),
    "edited by hand": (r"^c_lambda = .*?$", "c_lambda = 1.0"),
    "asymmetric": (r"^B_Vf = .*?(?=^b_Vf)", "B_Vf = [[1, 0], [1, 1]]\n"),
    "name unknown": (r'"UA2"', '"UA3"'),
    "names missing": (r"^model_parameters = \[.*?\]\n", ""),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_has_one_clear_error_that_names_it(case, problem, rng, tmp_path):
    pattern, replacement = BAD[case]
    parameters = random_parameters(
        problem, ThetaBlocks.from_problem(problem, **BLOCKS["physical"]), rng
    )
    path = parameters.save(tmp_path / "theta.toml")
    path.write_text(edited(path.read_text(), pattern, replacement))
    with pytest.raises(ParameterError) as caught:
        Parameters.load(path, problem)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_hand_edited_file_without_hash_is_read(problem, tmp_path):
    path = Parameters.naive(problem).save(tmp_path / "theta.toml")
    text = edited(path.read_text(), r'^hash = ".*?"\n', "")
    path.write_text(edited(text, r"^c_lambda = .*?$", "c_lambda = 7"))
    assert Parameters.load(path, problem)["c_lambda"] == 7.0
