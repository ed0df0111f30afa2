import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.errors import ScenarioError
from cosim.core.scenario import Penalty, Scenario, presets


def test_the_plant_as_it_is_at_a_time_is_a_scenario_of_its_own(paper):
    jump, fouled = Scenario.load("jump"), Scenario.load("fouled")
    first, second = (change.time for change in jump.plant.changes)
    assert jump.at(first - 1.0).hash == paper.hash
    assert jump.at(first).hash == jump.at(second - 1.0).hash == fouled.hash
    assert jump.at(second).plant.parameters == {"UA2": 6.84}
    assert fouled.at(1e9) == fouled


def test_changes_come_one_after_another(paper):
    change = {"time": 60.0, "parameters": {"UA2": 5.2}}
    with pytest.raises(ScenarioError, match="increasing times"):
        paper.replace({"plant": {"changes": [change, change]}})


@pytest.mark.parametrize("name", presets())
def test_toml_round_trip_is_exact(name, tmp_path):
    scenario = Scenario.load(name)
    path = tmp_path / "copy.toml"
    path.write_text(scenario.to_toml())
    assert Scenario.load(path) == scenario
    assert Scenario.load(path).hash == scenario.hash


def test_hash_sees_every_number_but_not_the_name(paper):
    assert paper.replace({"name": "mine", "description": "other"}).hash == paper.hash
    changed = [
        {"discount": 0.9},
        {"penalty": {"quadratic": [1.0, 1.01]}},
        {"disturbance": {"law": "normal"}},
        {"plant": {"parameters": {"UA2": 6.9}}},
        {"controller": {"horizon": 11}},
    ]
    hashes = {paper.hash} | {paper.replace(change).hash for change in changed}
    assert len(hashes) == 1 + len(changed)


def test_extends_states_only_what_differs(tmp_path, paper):
    (tmp_path / "a.toml").write_text('extends = "paper"\nname = "a"\ndiscount = 0.9\n')
    (tmp_path / "b.toml").write_text('extends = "a.toml"\nname = "b"\nsampling_time = 30.0\n')
    scenario = Scenario.load(tmp_path / "b.toml")
    expected = paper.replace({"name": "b", "discount": 0.9, "sampling_time": 30.0})
    assert scenario == expected


def test_an_fmu_path_is_relative_to_the_scenario_file(tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "paper"\n[plant]\nfmu = "my.fmu"\n')
    assert Scenario.load(tmp_path / "mine.toml").plant.fmu == str(tmp_path / "my.fmu")


# What follows `extends = "paper"`, and the name of the entry that is refused.
WRONG = {
    "wrong schema": ("schema = 2", "schema"),
    "wrong type": ('sampling_time = "60"', "sampling_time"),
    "negative": ("sampling_time = -1.0", "sampling_time"),
    "unknown field": ('[plant]\nstate = ["X2"]', "did you mean 'states'"),
    "name twice": ('[plant]\nactions = ["P100", "X2"]', "'X2' twice"),
    "not finite": ("[penalty]\nlinear = [nan, 1.0]", "penalty.linear[0]"),
    "wrong size": ("[bounds]\nstate_lower = [25.0]", "bounds.state_lower"),
    "bounds crossed": ("[bounds]\naction_lower = [500.0, 100.0]", "bounds.action_lower"),
    "law": ('[plant.mapping]\nlaw_codes = {uniform = "one"}', "plant.mapping.law_codes.uniform"),
}
BAD = {name: (f'extends = "paper"\n{text}', said) for name, (text, said) in WRONG.items()} | {
    "not TOML": ("a = = 1", "line 1"),
    "not text": (b"\xff\xfe\x00", "UTF-8"),
    "empty": ("", "schema"),
    "extends a number": ("extends = 3", "extends"),
    "extends itself": ('extends = "x.toml"', "extends"),
    "missing file": (None, "does not exist"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_documents_are_refused_in_one_clear_line(case, tmp_path):
    text, said = BAD[case]
    path = tmp_path / "x.toml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ScenarioError) as error:
        Scenario.load(path)
    message = str(error.value)
    assert "x.toml" in message and said in message and "\n" not in message


def test_a_seed_draws_the_same_random_plant_for_ever():
    first = Scenario.load("random-0")
    assert (first.name, first.sampling_time) == ("random-0", 120.0)
    assert first.plant.parameters == {
        "UA2": 6.395,
        "C": 3.282,
        "F3": 47.58,
        "Cp": 0.07219,
        "lambda_": 39.45,
        "lambda_s": 36.83,
    }
    assert first.disturbance.law == "normal"
    assert first.disturbance.ranges == (0.2898, 0.5795, 2.318, 1.449)
    assert Scenario.load("random-15").hash == "8a9a2a69910fa894"


@pytest.mark.parametrize("name", ["random", "random-", "random-x", "random-01", "random--1"])
def test_what_names_no_seed_is_no_random_plant(name):
    with pytest.raises(ScenarioError, match="unknown scenario"):
        Scenario.load(name)


PENALTY = Penalty([25, 40], [100, 80], [1e5, 2e5], [1.0, 3.0])


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
