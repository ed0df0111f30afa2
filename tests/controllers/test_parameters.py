import re

import numpy as np
import pytest

from controllers import Parameters, ThetaBlocks
from controllers.errors import ParameterError
from tests.helpers.sampling import evaporator_problem, random_parameters

BLOCKS = {
    "paper": {},
    "extended": {"slack_weights": True},
    "physical": {"slack_weights": True, "model_parameters": ("UA2", "h")},
}


@pytest.fixture(params=BLOCKS)
def parameters(request, problem, rng):
    return random_parameters(problem, ThetaBlocks.of(problem, **BLOCKS[request.param]), rng)


def test_naive_is_the_papers_guess(problem):
    theta = Parameters.naive(problem)
    np.testing.assert_array_equal(theta["B_l"], np.eye(4))
    np.testing.assert_array_equal(theta["B_Vf"], np.eye(2))
    np.testing.assert_array_equal(theta["x_l"], [25, 40])
    np.testing.assert_array_equal(theta["x_u"], [100, 80])
    assert theta["c_lambda"] == problem.reference_cost
    for name in ("B_lambda", "b_lambda", "b_Vf", "b_l", "c_f"):
        assert not theta[name].any()


def test_naive_takes_another_level_of_the_value(problem):
    assert Parameters.naive(problem, value_offset=1.0)["c_lambda"] == 1.0


def test_optional_blocks_start_at_the_true_penalty_and_the_nominal_model(problem):
    theta = Parameters.naive(problem, ThetaBlocks.of(problem, **BLOCKS["physical"]))
    np.testing.assert_array_equal(theta["w_sigma"], [1e5, 1e5])
    np.testing.assert_array_equal(theta["W_sigma"], [1, 1])
    np.testing.assert_array_equal(theta["p"], [6.84, 0.16])


def test_replace_changes_the_named_blocks_only(problem):
    before = Parameters.naive(problem)
    after = before.replace({"c_f": [0.5, -0.5]})
    np.testing.assert_array_equal(after["c_f"], [0.5, -0.5])
    changed = np.flatnonzero(after.theta != before.theta)
    assert changed.tolist() == list(range(*before.blocks.slices["c_f"].indices(after.blocks.size)))


def test_theta_cannot_be_written_nor_shared(problem):
    source = np.zeros(ThetaBlocks.of(problem).size)
    theta = Parameters(ThetaBlocks.of(problem), source)
    source[0] = 1.0
    assert theta.theta[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        theta.theta[0] = 1.0


def test_a_wrong_length_is_refused(problem):
    with pytest.raises(ParameterError, match=r"shape \(3,\); it must have \(31,\)"):
        Parameters(ThetaBlocks.of(problem), np.zeros(3))


def test_an_entry_that_is_not_finite_is_named(problem):
    blocks = ThetaBlocks.of(problem)
    theta = np.zeros(blocks.size)
    theta[blocks.slices["b_l"].start + 2] = np.nan
    with pytest.raises(ParameterError, match=re.escape("not finite at b_l[2]")):
        Parameters(blocks, theta)


def test_printing_shows_hash_and_each_block(parameters):
    text = str(parameters)
    assert parameters.hash in text
    assert [line.split()[0] for line in text.splitlines()[1:]] == list(parameters.blocks.slices)


# hash and file --------------------------------------------------------------------------------


def test_the_hash_tells_the_smallest_change(parameters):
    theta = parameters.theta.copy()
    theta[0] = np.nextafter(theta[0], np.inf)
    assert parameters.with_theta(theta).hash != parameters.hash
    assert parameters.with_theta(parameters.theta).hash == parameters.hash


def test_the_hash_tells_which_model_parameters_are_meant(problem):
    several = [ThetaBlocks.of(problem, model_parameters=(name,)) for name in ("a", "b")]
    first, second = (Parameters(blocks, np.ones(blocks.size)) for blocks in several)
    assert first.hash != second.hash


def test_a_file_gives_back_the_same_bits(parameters, problem, tmp_path):
    awkward = parameters.theta * np.pi * 1e-300
    awkward[0], awkward[1] = -0.0, 5e-324
    written = parameters.with_theta(awkward)
    read = Parameters.load(written.save(tmp_path / "theta.toml"), problem)
    assert read.theta.tobytes() == written.theta.tobytes()
    assert read.blocks == written.blocks
    assert read.hash == written.hash


def test_the_same_theta_makes_the_same_bytes(parameters, tmp_path):
    first, second = parameters.save(tmp_path / "a.toml"), parameters.save(tmp_path / "b.toml")
    assert first.read_bytes() == second.read_bytes()


def edited(text, pattern, replacement):
    changed, count = re.subn(pattern, replacement, text, flags=re.S | re.M)
    assert count, f"the test's pattern {pattern} does not occur"
    return changed


BAD = {
    "no toml": (r"\A", "= ", "is not valid TOML"),
    "another schema": (r"^schema = 1", "schema = 2", "schema is 2; this version reads schema = 1"),
    "no schema": (r"^schema = 1\n", "", "schema is None"),
    "key unknown": (
        r"\A",
        "model_parameter = ['h']\n",
        "not known: 'model_parameter'; a parameters",
    ),
    "table unknown": (r"\Z", "\n[meta]\nby = 'hand'\n", "not known: 'meta'"),
    "table misspelt": (r"\[theta\]", "[thetas]", "not known: 'thetas'"),
    "no table": (r"\[theta\].*", "", r"no table \[theta\]"),
    "table is a number": (r"\[theta\].*", "theta = 3", r"no table \[theta\]"),
    "block missing": (r"^b_Vf = \[.*?\]\n", "", "missing: b_Vf; not known: none"),
    "block unknown": (r"^b_Vf = ", "b_f = ", "missing: b_Vf; not known: b_f"),
    "half of the slack weights": (r"^w_sigma = \[.*?\]\n", "", "missing: w_sigma"),
    "wrong size": (r"^c_f = \[", "c_f = [1.0,", "block c_f has shape"),
    "ragged": (r"^c_f = \[", "c_f = [[1.0],", "block c_f holds no float64 numbers"),
    "text": (r"^c_lambda = .*?$", 'c_lambda = "much"', "block c_lambda holds no float64 numbers"),
    "boolean": (r"^c_lambda = .*?$", "c_lambda = true", "block c_lambda holds no float64 numbers"),
    "date": (
        r"^c_lambda = .*?$",
        "c_lambda = 2020-05-13",
        "block c_lambda holds no float64 numbers",
    ),
    "huge": (r"^c_lambda = .*?$", "c_lambda = 1" + 400 * "0", "c_lambda holds no float64 numbers"),
    "not a number": (r"^c_lambda = .*?$", "c_lambda = nan", "c_lambda has an entry that is not"),
    "infinite": (r"^c_lambda = .*?$", "c_lambda = inf", "c_lambda has an entry that is not"),
    "edited by hand": (r"^c_lambda = .*?$", "c_lambda = 1.0", "the file says .* delete its line"),
    "names are no list": (
        r"^model_parameters = \[.*?\]",
        'model_parameters = "h"',
        "list of names",
    ),
    "names are numbers": (
        r"^model_parameters = \[.*?\]",
        "model_parameters = [1]",
        "list of names",
    ),
    "name unknown": (r'"UA2"', '"UA3"', "no parameter 'UA3'"),
    "name doubled": (r'"UA2"', '"h"', "once each"),
    "names missing": (r"^model_parameters = \[.*?\]\n", "", "not known: p"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_has_one_clear_error_that_names_it(case, problem, rng, tmp_path):
    pattern, replacement, message = BAD[case]
    parameters = random_parameters(problem, ThetaBlocks.of(problem, **BLOCKS["physical"]), rng)
    path = parameters.save(tmp_path / "theta.toml")
    path.write_text(edited(path.read_text(), pattern, replacement))
    with pytest.raises(ParameterError, match=message) as caught:
        Parameters.load(path, problem)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_asymmetry_in_a_file_is_refused(problem, tmp_path):
    path = Parameters.naive(problem).save(tmp_path / "theta.toml")
    path.write_text(edited(path.read_text(), r"^B_Vf = .*?(?=^b_Vf)", "B_Vf = [[1, 0], [1, 1]]\n"))
    with pytest.raises(ParameterError, match="B_Vf must be symmetric"):
        Parameters.load(path, problem)


def test_a_hand_edited_file_without_hash_is_read(problem, tmp_path):
    path = Parameters.naive(problem).save(tmp_path / "theta.toml")
    text = edited(path.read_text(), r'^hash = ".*?"\n', "")
    path.write_text(edited(text, r"^c_lambda = .*?$", "c_lambda = 7"))
    assert Parameters.load(path, problem)["c_lambda"] == 7.0


@pytest.mark.parametrize("name", ["missing.toml", "."])
def test_a_path_that_is_no_file_is_refused(name, problem, tmp_path):
    with pytest.raises(ParameterError, match=r"does not exist|is not a regular file"):
        Parameters.load(tmp_path / name, problem)


def test_bytes_that_are_no_text_are_refused(problem, tmp_path):
    (tmp_path / "theta.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ParameterError, match="is not UTF-8 text"):
        Parameters.load(tmp_path / "theta.toml", problem)


def test_a_file_for_another_model_size_is_refused(tmp_path):
    problem = evaporator_problem()
    path = Parameters.naive(problem).save(tmp_path / "theta.toml")
    text = edited(path.read_text(), r"^x_l = \[.*?\]", "x_l = [25.0]")
    path.write_text(text)
    with pytest.raises(ParameterError, match=r"x_l has shape \(1,\); it must have \(2,\)"):
        Parameters.load(path, problem)
