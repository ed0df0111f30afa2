import gc
import mmap
from pathlib import Path
from types import SimpleNamespace

import fmpy
import numpy as np
import pytest

import fmus
from cosim import FmuPlant, Scenario
from cosim.core.errors import PlantError
from cosim.plant.fmu_plant import refuse_bounds_elsewhere

ACTIONS = np.random.default_rng(7).uniform(100, 400, (50, 2))


def resident():
    """Resident memory of this process in bytes (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


def stepped(plant, actions):
    """All numbers of the steps under these actions."""
    # The last part is what sensors show; these plants have none.
    return np.hstack([part for a in actions for part in plant.step(a)[:-1]])


def run(plant, seed):
    return plant.reset(seed).tobytes() + stepped(plant, ACTIONS).tobytes()


def test_nominal_plant_rests_at_the_reference():
    with FmuPlant("nominal") as plant:
        scenario = plant.scenario
        plant.reset(0)
        for _ in range(100):
            step = plant.step(scenario.reference_action)
        np.testing.assert_allclose(step.s, scenario.reference_state, rtol=0, atol=1e-9)
        assert step.stage_cost == pytest.approx(scenario.controller.reference_cost, abs=1e-6)
        assert step.disturbance.tolist() == list(scenario.disturbance.nominal)


def test_penalty_is_that_of_the_state_before_the_step(plant):
    plant.reset(3)
    before = plant.state
    for a in ([100.0, 200.0], [100.0, 200.0], [300.0, 200.0]):
        step = plant.step(a)
        assert step.penalty == plant.penalty(before.tolist())
        before = step.s
    assert step.penalty > 0


def test_both_fmi_versions_give_the_same_bits(paper):
    with FmuPlant(paper, "evaporator") as fmi2, FmuPlant(paper, "evaporator_fmi3") as fmi3:
        assert (fmi2.fmi_version, fmi3.fmi_version) == ("2.0", "3.0")
        for seed in (0, 5, 2**40 + 3, 2**64 - 1):
            assert run(fmi2, seed) == run(fmi3, seed)


def test_a_seed_repeats_after_reset_and_another_differs(plant):
    first = run(plant, 11)
    assert run(plant, 12) != first
    assert run(plant, 11) == first


def test_the_normal_law_is_a_choice_of_the_scenario(paper):
    scenario = paper.replace({"disturbance": {"law": "normal"}})
    with FmuPlant(scenario) as plant:
        plant.reset(2)
        drawn = np.array([plant.step(paper.reference_action).disturbance for _ in range(2000)])
    offset = (drawn - paper.disturbance.nominal) / paper.disturbance.ranges
    assert np.abs(offset).max() > 2.5
    np.testing.assert_allclose(offset.std(axis=0), 1.0, rtol=0.1)


def test_an_episode_can_start_elsewhere_and_the_next_starts_at_home(plant, paper):
    assert plant.reset(1, [30.0, 60.0]).tolist() == [30.0, 60.0]
    assert plant.reset(1).tolist() == paper.initial_state.tolist()


def test_restore_repeats_what_followed_the_snapshot(plant):
    plant.reset(8)
    stepped(plant, ACTIONS[:5])
    snapshot, state = plant.snapshot(), plant.state
    first = stepped(plant, ACTIONS[5:15])
    for _ in range(2):
        np.testing.assert_array_equal(plant.restore(snapshot), state)
        assert plant.k == 5
        np.testing.assert_array_equal(stepped(plant, ACTIONS[5:15]), first)


@pytest.mark.slow
def test_a_million_snapshots_leave_memory_flat(plant):
    plant.reset(0)
    sizes = []
    for _ in range(4):
        for _ in range(250_000):
            plant.restore(plant.snapshot())
        sizes.append(resident())
    assert sizes[-1] - sizes[0] < 1 << 20


BAD_ACTIONS = {
    "NaN": [float("nan"), 200.0],
    "infinite": [float("inf"), 200.0],
    "too short": [200.0],
    "too long": [200.0, 200.0, 200.0],
    "matrix": np.array([[200.0, 200.0]]),
    "text": ["a", "b"],
    "none": None,
    "a number": 3.0,
}


@pytest.mark.parametrize("case", BAD_ACTIONS)
def test_a_bad_action_is_refused_by_name_and_leaves_the_plant_as_it_was(case, plant):
    plant.reset(1)
    state = plant.state
    with pytest.raises(PlantError, match=r"action must be 2 finite numbers \(P100, F200\)"):
        plant.step(BAD_ACTIONS[case])
    np.testing.assert_array_equal(plant.state, state)
    plant.step([200.0, 200.0])


def test_an_action_out_of_the_fmus_range_is_refused_with_its_own_words(plant):
    plant.reset(1)
    with pytest.raises(PlantError, match=r"P100 = 500 is outside \[100, 400\]"):
        plant.step([500.0, 200.0])
    with pytest.raises(PlantError, match="call reset first"):
        plant.step([200.0, 200.0])
    plant.reset(1)
    plant.step([200.0, 200.0])


BAD_STARTS = [(seed, None, "seed must be an integer") for seed in (-1, 1 << 64, 1.5, None, "1")]
BAD_STARTS += [
    (0, state, r"initial_state must be 2 finite numbers \(X2, P2\)")
    for state in ([1.0], [float("nan"), 50.0], [[25.0, 50.0]])
]


@pytest.mark.parametrize(("seed", "state", "words"), BAD_STARTS)
def test_a_seed_or_initial_state_that_is_none_is_refused(plant, seed, state, words):
    with pytest.raises(PlantError, match=words):
        plant.reset(seed, state)


def test_calls_out_of_order_are_refused(plant):
    with pytest.raises(PlantError, match="call reset first"):
        plant.step([200.0, 200.0])
    with pytest.raises(PlantError, match="call reset first"):
        plant.snapshot()
    plant.reset(0)
    snapshot = plant.snapshot()
    plant.close()
    plant.close()
    for call in (
        lambda: plant.reset(0),
        lambda: plant.step([200.0, 200.0]),
        plant.snapshot,
        lambda: plant.restore(snapshot),
    ):
        with pytest.raises(PlantError, match="closed"):
            call()


def test_a_snapshot_of_another_plant_is_refused(plant, paper):
    plant.reset(0)
    with FmuPlant(paper) as other:
        other.reset(0)
        with pytest.raises(PlantError, match="another plant"):
            other.restore(plant.snapshot())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"states": ["X2", "P3"]}, ["no variable 'P3'", "plant.states", "did you mean"]),
        ({"actions": ["P100", "X2"]}, ["twice"]),
        ({"actions": ["P100", "F2"]}, ["'F2'", "not an input", "plant.actions"]),
        ({"stage_cost": "cost"}, ["no variable 'cost'"]),
        ({"stage_cost": "law"}, ["'law'", "Enumeration"]),
        ({"parameters": {"X2": 3.0}}, ["'X2'", "output", "plant.parameters"]),
        ({"parameters": {"law": 1.5}}, ["'law'", "cannot take 1.5"]),
        ({"mapping": {"seed": ["h"]}}, ["'h'", "plant.mapping.seed"]),
        ({"mapping": {"sampling_time": "Ts"}}, ["no variable 'Ts'", "plant.mapping.sampling_time"]),
    ],
)
def test_a_scenario_that_does_not_fit_the_fmu_is_refused_by_name(paper, change, words):
    from cosim.core.errors import CosimError

    with pytest.raises(CosimError) as error:
        FmuPlant(paper.replace({"plant": change}))
    for word in words:
        assert word in str(error.value)


def _changed(name, value, time=120.0):
    changes = [{"time": time, "parameters": {name: value}}]
    return Scenario.load("paper").replace({"plant": {"changes": changes}})


def _run(scenario, steps, fmu):
    with FmuPlant(scenario, fmu) as plant:
        plant.reset(5)
        return np.array([plant.step(scenario.reference_action).s for _ in range(steps)])


@pytest.mark.parametrize("fmu", ["evaporator", "evaporator_fmi3"])
def test_a_change_takes_effect_at_its_sample_and_ends_with_the_reset(fmu):
    scenario = _changed("UA2", 5.2)
    before, seen = (_run(each, 3, fmu) for each in (Scenario.load("paper"), scenario))
    np.testing.assert_array_equal(seen[:2], before[:2])
    assert seen[2, 1] > before[2, 1]
    with FmuPlant(scenario, fmu) as plant:
        plant.reset(5)
        for _ in range(2):
            plant.step(scenario.reference_action)
        saved = plant.snapshot()
        steps = [plant.step(scenario.reference_action).s for _ in range(2)]
        plant.restore(saved)
        np.testing.assert_array_equal(plant.step(scenario.reference_action).s, steps[0])
        plant.reset(5)
        np.testing.assert_array_equal(plant.step(scenario.reference_action).s, before[0])


@pytest.mark.parametrize(
    ("name", "message"),
    [("UA3", "no variable 'UA3'"), ("X2_start", "is not tunable; plant.changes")],
)
def test_a_change_of_what_cannot_be_changed_is_refused(name, message):
    with pytest.raises(PlantError, match=message):
        FmuPlant(_changed(name, 1.0))


def test_bytes_that_are_no_plant_state_are_refused(plant):
    plant.reset(0)
    with pytest.raises(PlantError, match="not a serialised plant state"):
        plant.deserialise(b"cut")


def with_one_law(scenario, law):
    """The scenario as if its FMU had a single law, and no switch of the noise."""
    mapping = {"law": None, "law_codes": {}, "stochastic": None}
    return scenario.replace({"plant": {"mapping": mapping}, "disturbance": {"law": law}})


def test_an_fmu_without_a_choice_of_laws_draws_by_its_ranges(paper):
    with FmuPlant(paper) as plant, FmuPlant(with_one_law(paper, "uniform")) as single:
        for each in (plant, single):
            each.reset(5)
        expected = plant.step(paper.reference_action)
        found = single.step(paper.reference_action)
    np.testing.assert_array_equal(found.disturbance, expected.disturbance)


def test_an_fmu_without_a_switch_of_its_noise_is_undisturbed_by_ranges_of_zero(paper):
    with FmuPlant(with_one_law(paper, "none")) as plant:
        plant.reset(5)
        step = plant.step(paper.reference_action)
    np.testing.assert_array_equal(step.disturbance, paper.disturbance.nominal)


def test_who_simulates_by_fmpy_beside_us_does_not_take_our_messages(paper):
    taken = []
    fmpy.simulate_fmu(str(fmus.path()), stop_time=60.0, logger=lambda *words: taken.append(words))
    gc.collect()
    count = len(taken)
    longest = paper.replace({"disturbance": {"time_constant": [1e9] * 4}})
    with pytest.raises(PlantError, match="outside"), FmuPlant(longest) as plant:
        plant.reset(0)
    assert len(taken) == count


def test_bounds_that_the_fmu_never_meets_are_refused(paper):
    stated = {"P2": (233.0, 353.0)}
    in_kelvin = SimpleNamespace(range=lambda name: stated.get(name, (-np.inf, np.inf)))
    with pytest.raises(
        PlantError, match="bounds P2 to 40 … 80, and the FMU has it from 233 to 353"
    ):
        refuse_bounds_elsewhere(paper, in_kelvin)
    stated["P2"] = (60.0, 100.0)
    refuse_bounds_elsewhere(paper, in_kelvin)
