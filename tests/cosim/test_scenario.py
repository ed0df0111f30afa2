import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.errors import ScenarioError
from cosim.penalty import Penalty
from cosim.scenario import Scenario, presets


def test_paper_holds_the_numbers_of_the_paper(paper):
    assert paper.sampling_time == 60.0
    assert paper.discount == 0.99
    assert paper.plant.states == ("X2", "P2")
    assert paper.plant.actions == ("P100", "F200")
    assert paper.disturbance.law == "uniform"
    assert paper.disturbance.nominal == (5.0, 10.0, 40.0, 25.0)
    assert paper.disturbance.ranges == (1.0, 2.0, 8.0, 5.0)
    np.testing.assert_array_equal(paper.state_lower, [25, 40])
    np.testing.assert_array_equal(paper.state_upper, [100, 80])
    np.testing.assert_array_equal(paper.action_lower, [100, 100])
    np.testing.assert_array_equal(paper.action_upper, [400, 400])
    np.testing.assert_array_equal(paper.penalty_linear, [1e5, 1e5])
    np.testing.assert_array_equal(paper.penalty_quadratic, [1, 1])
    assert paper.controller.horizon == 10
    assert paper.controller.value_offset is None, "left to the algorithm"
    assert paper.exploration is None, "left to the algorithm"


def test_paper_reference_is_the_nominal_optimum_of_the_paper(paper):
    assert paper.reference_state.round(2).tolist() == [25.0, 49.74]
    assert paper.reference_action.round(2).tolist() == [191.71, 215.89]
    assert round(paper.controller.reference_cost, 4) == 6210.3845


def test_other_presets_differ_from_paper_in_what_their_name_says(paper):
    differing = {
        name: {
            key
            for key, value in Scenario.load(name).to_dict().items()
            if value != paper.to_dict()[key] and key not in ("name", "description")
        }
        for name in presets()
        if name not in ("reactor", "tanks")
    }
    assert differing == {
        "paper": set(),
        "nominal": {"disturbance"},
        "fast-sampling": {"sampling_time"},
        "fouled": {"plant"},
        "mismatched": {"plant", "disturbance"},
        "drifting": {"plant"},
        "jump": {"plant"},
    }


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


@pytest.mark.parametrize("name", ["fouled", "mismatched"])
def test_a_wrong_model_is_wrong_in_the_plant_alone(paper, name):
    scenario, told = Scenario.load(name), paper.to_dict()
    for table in ("controller", "bounds", "penalty", "sampling_time", "discount"):
        assert scenario.to_dict()[table] == told[table]
    expected = dict(paper.to_dict()["plant"], parameters=dict(scenario.plant.parameters))
    assert scenario.to_dict()["plant"] == expected
    for parameter, value in scenario.plant.parameters.items():
        assert f"{parameter}" in scenario.description and f"{value:g}" in scenario.description


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


def test_an_unknown_preset_is_told_the_nearest_one():
    with pytest.raises(ScenarioError, match="did you mean 'paper'"):
        Scenario.load("papr")


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


def test_random_plants_differ_from_paper_in_what_the_controller_is_not_told(paper):
    family = [Scenario.load(f"random-{seed}") for seed in range(64)]
    assert len({scenario.hash for scenario in family}) == 64
    for scenario in family:
        assert scenario.controller == paper.controller
        assert scenario.bounds == paper.bounds
        assert 0.8 * 6.84 - 1e-3 <= scenario.plant.parameters["UA2"] <= 1.3 * 6.84 + 1e-3
        scale = 1.0 if scenario.disturbance.law == "uniform" else 3.0**0.5
        factors = scale * np.array(scenario.disturbance.ranges) / paper.disturbance.ranges
        np.testing.assert_allclose(factors, factors[0], rtol=1e-3)
        assert 0.499 < factors[0] < 2.001
    assert {scenario.sampling_time for scenario in family} == {30.0, 60.0, 120.0}
    assert {scenario.disturbance.law for scenario in family} == {"uniform", "normal"}


@pytest.mark.parametrize("name", ["random", "random-", "random-x", "random-01", "random--1"])
def test_what_names_no_seed_is_no_random_plant(name):
    with pytest.raises(ScenarioError, match="unknown scenario"):
        Scenario.load(name)


def test_a_scenario_can_extend_a_random_plant(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('extends = "random-3"\nname = "mine"\n')
    assert Scenario.load(path).hash == Scenario.load("random-3").hash


PENALTY = Penalty([25, 40], [100, 80], [1e5, 2e5], [1.0, 3.0])


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
