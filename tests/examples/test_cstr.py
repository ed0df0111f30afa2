"""The second plant: built from its sources, run from the command line, learned."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from fmus.own import build_folder

EXAMPLE = Path(__file__).parents[2] / "examples" / "cstr"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of the example with its FMU built."""
    target = tmp_path_factory.mktemp("cstr")
    for path in EXAMPLE.glob("cstr.[ptc]*"):
        (target / path.name).write_bytes(path.read_bytes())
    build_folder(EXAMPLE, target / "cstr.fmu")
    return target


@pytest.fixture
def scenario(folder, monkeypatch):
    monkeypatch.syspath_prepend(str(folder))
    return Scenario.load(folder / "cstr.toml")


def cosim(folder, *words):
    command = [sys.executable, "-m", "cosim", *words, "--json"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_all_of_it_is_at_most_150_lines():
    files = ["cstr.c", "cstr.py", "cstr.toml", "modelDescription.xml"]
    assert sum(len((EXAMPLE / name).read_text().splitlines()) for name in files) <= 150


def test_the_nominal_plant_obeys_the_mole_balances(scenario):
    quiet = scenario.replace({"plant": {"parameters": {"range": 0.0}}})
    with FmuPlant(quiet) as plant:
        s = plant.reset(0, [0.9, 0.2])
        # Total moles: d(cA + cB)/dt = q/V (1 − cA − cB), whatever the reaction does.
        step = plant.step([8.0])
    expected = 1.0 + (s.sum() - 1.0) * np.exp(-0.8 * 0.5)
    assert step.s.sum() == pytest.approx(expected, abs=1e-4)
    assert step.stage_cost == pytest.approx(4.0 - 2 * 8.0 * 0.2, rel=1e-12)


def test_the_published_optimum_is_held(scenario):
    quiet = scenario.replace({"plant": {"parameters": {"range": 0.0}}})
    with FmuPlant(quiet) as plant:
        trajectory = simulate(plant, naive(quiet), 60, seed=0)
    np.testing.assert_allclose(trajectory["q"][-1], 12.0, atol=1e-3)
    np.testing.assert_allclose(trajectory.states[-1], [0.5, 0.5], atol=1e-4)
    assert trajectory["stage_cost"][-1] == pytest.approx(-6.0, abs=1e-3)


def test_feed_is_drawn_anew_each_sample_and_repeats_with_the_seed(scenario):
    with FmuPlant(scenario) as plant:
        first = simulate(plant, naive(scenario), 400, seed=1)
        again = simulate(plant, naive(scenario), 400, seed=1)
        other = simulate(plant, naive(scenario), 400, seed=2)
    feed = first["cAf"]
    np.testing.assert_array_equal(feed, again["cAf"])
    assert not np.isin(feed, other["cAf"]).any()
    assert len(np.unique(feed)) == 400
    # Uniform on [0.9, 1.1]: standard deviation 0.2/√12, its error 4 % at this size.
    assert feed.std() == pytest.approx(0.2 / np.sqrt(12), rel=0.12)
    assert abs(feed.mean() - 1.0) < 4 * 0.0577 / 20


def test_rti_runs_from_the_command_line(folder):
    summary = cosim(folder, "simulate", "--scenario", "cstr.toml", "--steps", "500", "--out", "run")
    assert summary["failures"] == 0
    assert summary["statuses"] == {"solved": 500}
    # The mean may beat the nominal optimum by what the noise gives, never by a tenth.
    assert -6.1 < summary["J"] < -5.8
    with (folder / "run" / "trajectory.csv").open() as stream:
        assert next(csv.reader(line for line in stream if not line.startswith("#")))


@pytest.mark.slow
def test_learning_takes_the_plant_as_it_comes(folder):
    words = ["train", "--scenario", "cstr.toml", "--algorithm", "q-learning", "--samples", "4000"]
    words += ["--set", "exploration_deviation=[0.3]", "--out", "learned"]
    summary = cosim(folder, *words)
    assert summary["status"] == "finished"
    assert -6.1 < summary["J"] < -5.85
    assert (folder / "learned" / "parameters.toml").is_file()


def test_a_plant_that_cannot_save_its_state_leaves_no_checkpoint_and_says_so(folder):
    command = [sys.executable, "-m", "cosim", "train", "-s", "cstr.toml", "-a", "q-learning"]
    command += ["--samples", "100", "--log-every", "100", "--evaluate-every", "100"]
    command += ["--checkpoint-every", "100", "--out", "short"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert "--resume is not possible" in result.stderr
    assert "canGetAndSetFMUstate" in result.stderr
    assert "native code of" in result.stderr
    assert not (folder / "short" / "checkpoint.npz").exists()
