import os
import signal

import numpy as np
import pytest

from cosim import FmuPlant, simulate
from cosim.errors import CapabilityError, PlantError
from cosim.plant import IsolatedPlant
from tests.helpers.loop import Hold, Proportional
from tests.helpers.tank import build_tank, write_scenario

ACTIONS = np.random.default_rng(7).uniform(100, 400, (10, 2))


@pytest.fixture(scope="module")
def tanks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tank")
    return {saves: build_tank(folder, saves) for saves in (True, False)}


@pytest.fixture(scope="module")
def isolated(paper):
    with IsolatedPlant(paper) as plant:
        yield plant


def test_a_run_has_the_same_bits_as_in_this_process(isolated, paper):
    with FmuPlant(paper) as plant:
        here = simulate(plant, Proportional(paper), 100, seed=2)
    there = simulate(isolated, Proportional(paper), 100, seed=2)
    assert here.to_csv() == there.to_csv()
    assert (isolated.k, isolated.time) == (100, 6000.0)


def test_snapshots_live_in_the_other_process(isolated):
    isolated.reset(1)
    snapshot = isolated.snapshot()
    first = [isolated.step(a).s for a in ACTIONS]
    isolated.restore(snapshot)
    assert isolated.k == 0
    np.testing.assert_array_equal([isolated.step(a).s for a in ACTIONS], first)
    del snapshot
    isolated.reset(1)
    assert isolated.dropped == []


def test_errors_come_across_with_type_and_message(isolated, tanks, tmp_path, paper):
    isolated.reset(0)
    for action in ([float("nan"), 1.0], [1.0], "text", None):
        with pytest.raises(PlantError, match=r"action must be 2 finite numbers"):
            isolated.step(action)
    with pytest.raises(PlantError, match="seed must be an integer"):
        isolated.reset(-1)
    with pytest.raises(PlantError, match="no variable 'X7'"):
        IsolatedPlant(paper.replace({"plant": {"states": ["X7", "P2"]}}))
    with IsolatedPlant(write_scenario(tmp_path, tanks[False])) as plain:
        plain.reset(0)
        with pytest.raises(CapabilityError, match="save and restore"):
            plain.snapshot()


def test_a_crash_of_the_fmu_is_an_error_that_names_signal_and_step(tanks, tmp_path):
    scenario = write_scenario(tmp_path, tanks[True], fault=5)
    with (
        IsolatedPlant(scenario) as plant,
        pytest.raises(PlantError, match=r"tank.*died by SIGABRT at step 0"),
    ):
        simulate(plant, Hold([1.0]), 5, seed=0)


def test_a_killed_process_is_reported_and_a_new_plant_works(paper):
    with IsolatedPlant(paper) as plant:
        plant.reset(0)
        plant.step(ACTIONS[0])
        os.kill(plant._process.pid, signal.SIGKILL)
        with pytest.raises(PlantError, match="died by SIGKILL at step 1"):
            plant.step(ACTIONS[0])
    with IsolatedPlant(paper) as plant:
        plant.reset(0)


def test_a_process_that_hangs_is_ended(paper):
    with IsolatedPlant(paper, timeout=20.0) as plant:
        plant.reset(0)
        plant._timeout = 0.2
        os.kill(plant._process.pid, signal.SIGSTOP)
        with pytest.raises(PlantError, match=r"did not answer within 0\.2 s"):
            plant.step(ACTIONS[0])


def test_a_closed_plant_refuses_calls(paper):
    plant = IsolatedPlant(paper)
    plant.close()
    plant.close()
    with pytest.raises(PlantError, match="closed"):
        plant.reset(0)
