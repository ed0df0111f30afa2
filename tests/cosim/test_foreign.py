"""FMUs that this project did not write, or that misbehave."""

import json

import numpy as np
import pytest

from cosim import FmuPlant, simulate
from cosim.errors import CapabilityError, PlantError
from tests.helpers.command import run_cosim
from tests.helpers.loop import Hold
from tests.helpers.tank import build_tank, write_scenario


@pytest.fixture(scope="module")
def tanks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tank")
    return {saves: build_tank(folder, saves) for saves in (True, False)}


@pytest.mark.parametrize("saves", [True, False])
def test_a_foreign_fmu_runs_in_the_loop(tanks, tmp_path, saves):
    with FmuPlant(write_scenario(tmp_path, tanks[saves])) as plant:
        trajectory = simulate(plant, Hold([2.0]), 20, seed=0)
    k = np.arange(20)
    expected = 2.0 + (1.0 - 2.0) * np.exp(-k * 0.5 / 4.0)
    np.testing.assert_allclose(trajectory["x"], expected, rtol=1e-12)
    np.testing.assert_array_equal(trajectory["stage_cost"], np.full(20, 4.0))
    np.testing.assert_array_equal(trajectory["penalty"], np.zeros(20))
    assert trajectory.signals["x"].unit == "m"
    assert trajectory.disturbances.shape == (20, 0)


def test_a_foreign_fmu_that_saves_its_state_has_snapshots(tanks, tmp_path):
    with FmuPlant(write_scenario(tmp_path, tanks[True])) as plant:
        plant.reset(0)
        plant.step([3.0])
        snapshot = plant.snapshot()
        expected = plant.step([2.0]).s
        plant.restore(snapshot)
        np.testing.assert_array_equal(plant.step([2.0]).s, expected)
        with pytest.raises(CapabilityError, match=r"serialise its state.*canSerializeFMUstate"):
            plant.serialise(snapshot)


def test_a_missing_capability_is_an_error_only_when_asked_for(tanks, tmp_path):
    with FmuPlant(write_scenario(tmp_path, tanks[False], mapped=False)) as plant:
        plant.reset(0)
        plant.step([3.0])
        with pytest.raises(CapabilityError, match=r"save and restore.*canGetAndSetFMUstate"):
            plant.snapshot()
        with pytest.raises(CapabilityError, match=r"plant\.mapping\.initial_state"):
            plant.reset(0, [2.0])
        plant.reset(0)
        plant.step([3.0])


def test_returned_nan_is_an_error_that_names_variable_and_step(tanks, tmp_path):
    with FmuPlant(write_scenario(tmp_path, tanks[True], fault=1)) as plant:
        plant.reset(0)
        with pytest.raises(PlantError, match="returned x = nan at step 0"):
            plant.step([1.0])


@pytest.mark.parametrize(
    ("fault", "words"), [(2, "error: tank: out of water"), (3, "fatal: tank: burst")]
)
def test_a_failed_call_reports_what_the_fmu_logged(tanks, tmp_path, fault, words):
    with FmuPlant(write_scenario(tmp_path, tanks[True], fault=fault)) as plant:
        plant.reset(0)
        with pytest.raises(PlantError, match=f"fmi2DoStep returned {words}"):
            plant.step([1.0])


def test_after_a_fatal_error_every_call_is_refused(tanks, tmp_path):
    plant = FmuPlant(write_scenario(tmp_path, tanks[True], fault=3))
    plant.reset(0)
    with pytest.raises(PlantError, match="burst"):
        plant.step([1.0])
    with pytest.raises(PlantError, match="fatal"):
        plant.reset(0)
    plant.close()


def test_a_chatty_fmu_does_not_spoil_json(tanks, tmp_path):
    scenario = write_scenario(tmp_path, tanks[True], fault=4)
    words = ["simulate", "--scenario", scenario, "--out", tmp_path / "out", "--json"]
    result = run_cosim(*words, "--controller", "tests.helpers.loop:hold", "--steps", "3")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["samples"] == 3
    assert "a chatty FMU" in result.stderr
