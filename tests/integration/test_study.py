"""A study as users run it: their own algorithm beside ours, killed twice, on one core, two, Dask.

The study's folder lies outside the checkout, and the command runs as a process of its own.
"""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from tests.helpers.command import run_cosim

pytestmark = pytest.mark.slow

TABLES = ("evaluation.csv", "curves.csv", "runs.csv", "summary.csv", "aggregate.csv", "study.json")
STUDY = """\
schema = 1
name = "mine"
scenarios = ["paper", "other.toml"]
training_seeds = { first = 0, count = 3 }
evaluation = { seeds = 2, steps = { default = 40, other = 30 } }
curves = { points = 2, seeds = 2, steps = 40 }

[[case]]
name = "mine"
algorithm = "capped_td:CappedTd"
samples = 600
settings = { radius = [0.02, 0.05] }
training = { checkpoint_every = 300 }

[[case]]
name = "q"
algorithm = "q-learning"
samples = 600
settings = { exploration_probability = [0.5, 1.0] }
training = { checkpoint_every = 300 }

[[case]]
controller = ["naive", "my_controller:hold"]
"""
CONTROLLER = """\
from types import SimpleNamespace


class Hold:
    def __init__(self, action):
        self.solution = SimpleNamespace(
            action=action, value=float("nan"), status="solved", residual=float("nan"),
            predicted_states=None, predicted_actions=None,
        )

    def reset(self): ...

    def prepare(self): ...

    def feedback(self, s, a=None):
        return self.solution


def hold(scenario):
    return Hold(scenario.reference_action)
"""
UNDER_WAY = "runs/*/*/*/checkpoint.npz"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("user")
    run_cosim("new", "rule", "capped_td", folder=folder, check=True)
    (folder / "my_controller.py").write_text(CONTROLLER)
    (folder / "other.toml").write_text('extends = "paper"\nname = "other"\ndiscount = 0.95\n')
    (folder / "study.toml").write_text(STUDY)
    (folder / "elsewhere").mkdir()
    return folder


def start(folder, out, *options):
    arguments = ["study", "run", "../study.toml", "--out", str(out), "--json", *options]
    # A session of its own, so that its workers can be killed with it.
    return subprocess.Popen(
        [sys.executable, "-m", "cosim", *arguments],
        cwd=folder / "elsewhere",
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finish(process):
    out, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    return json.loads(out)


def contents(out):
    return {name: (out / name).read_bytes() for name in TABLES}


@pytest.fixture(scope="module")
def undisturbed(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    summary = finish(start(folder, out, "--jobs", "1"))
    assert summary["runs"] == 2 * (2 * 2 * 3 + 2 + 1), "two algorithms, settings, scenarios; J*"
    return contents(out)


def trained(out):
    """Samples that are safe, of trainings begun and ended."""
    return sum(
        json.loads(path.read_text()).get("samples", 0) for path in out.glob("runs/*/*/*/run.json")
    )


def kill_after(process, out, samples):
    """Kill a run and its workers once so many samples are stored; returns how many there are.

    A training is under way then: between two of them a kill would show nothing.
    """
    deadline = time.monotonic() + 300
    while trained(out) < samples or not list(out.glob(UNDER_WAY)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    return trained(out)


def test_a_run_that_was_killed_twice_ends_in_the_same_bytes(folder, undisturbed, tmp_path):
    first = kill_after(start(folder, tmp_path, "--jobs", "2"), tmp_path, 600)
    second = kill_after(start(folder, tmp_path, "--jobs", "2"), tmp_path, first + 3000)
    assert second < 2 * 12 * 600, "it was killed before its end"
    assert list(tmp_path.glob(UNDER_WAY)), "a training was under way"
    finish(start(folder, tmp_path, "--jobs", "2"))
    assert contents(tmp_path) == undisturbed
