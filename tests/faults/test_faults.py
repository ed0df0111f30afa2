"""Kills, full disks, locked folders, clocks that jump, plants and solvers that fail."""

import ctypes
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.kill import campaign
from controllers import Parameters, Problem, QpError, RtiNmpc
from controllers.factories import naive
from controllers.qp import DaqpBackend
from cosim import FmuPlant, Scenario, simulate
from learning.training import run_training
from tests.helpers.command import run_cosim
from tests.helpers.tank import build_tank, write_scenario
from tests.helpers.training import make_run

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2
TRAIN = "train --algorithm q-learning --samples 600 --log-every 200 --evaluate-every 600"


def command_line(folder, *words, limit=None):
    """Run `cosim` in a process of its own that obeys file permissions, as root else does not.

    `limit` is the largest size in bytes of a file that it may write.
    """

    def confine():
        for capability in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    root = str(Path(__file__).parents[2])
    return run_cosim(*words, folder=folder, env={"PYTHONPATH": root}, preexec_fn=confine)


def refused(result):
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    return [line for line in result.stderr.splitlines() if line.startswith("error: ")][-1]


# Kills -----------------------------------------------------------------------------------------


# A study trains, evaluates, starts workers and goes on from checkpoints: the others do less.
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize(
    "job",
    [
        pytest.param("study", marks=pytest.mark.slow),
        pytest.param("training", marks=pytest.mark.campaign),
        pytest.param("recording", marks=pytest.mark.campaign),
    ],
)
def test_a_signal_loses_nothing_and_leaves_nothing(job):
    campaign(1, seed=os.getpid(), names=(job,))


# Endurance -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_short_endurance_run_fails_nowhere_and_does_not_grow():
    words = [sys.executable, "-m", "benchmarks.endurance", "--samples", "5000"]
    root = Path(__file__).parents[2]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=True)
    seen = json.loads(done.stdout)
    assert seen["status"] == "finished"
    assert seen["failures"] == 0
    assert len(seen["J"]) == 10
    assert seen["growth_mb"] < 5


# Disks -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_old_files_stay(tmp_path):
    words = "simulate --steps 400 --out out"
    assert command_line(tmp_path, *words.split()).returncode == 0
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir() if path.is_file()}
    again = [*words.split(), "--seed", "1", "--overwrite"]
    assert "File too large" in refused(command_line(tmp_path, *again, limit=8000))
    after = {path: path.read_bytes() for path in (tmp_path / "out").iterdir() if path.is_file()}
    assert after.keys() == before.keys()
    big = [path for path, data in before.items() if len(data) > 8000]
    assert big
    for path in big:
        assert after[path] == before[path]


@pytest.mark.slow
def test_a_recording_that_does_not_fit_is_no_recording(tmp_path):
    words = ["simulate", "--steps", "2000", "--record", "--out", "out"]
    said = refused(command_line(tmp_path, *words, limit=60_000))
    assert "recording" in said
    assert not (tmp_path / "out" / "run.rrd").exists()


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o555)
    said = refused(command_line(tmp_path, *TRAIN.split(), "--out", "locked"))
    assert "cannot write to folder 'locked': Permission denied" in said
    assert not list(folder.iterdir())


@pytest.mark.slow
def test_too_few_files_that_may_be_open_are_one_line(tmp_path):
    # So much work that workers are started.
    words = ["evaluate", "--seeds", "9", "--steps", "90000", "--jobs", "2", "--out", "out"]
    root = str(Path(__file__).parents[2])
    few = lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (16, 16))  # noqa: E731
    done = run_cosim(*words, folder=tmp_path, env={"PYTHONPATH": root}, preexec_fn=few)
    assert "ulimit -n" in refused(done)


# Clocks ----------------------------------------------------------------------------------------


def test_a_clock_that_jumps_changes_no_result(monkeypatch, tmp_path):
    scenario = Scenario.load("paper")
    rng = np.random.default_rng(0)

    def run(name):
        with FmuPlant(scenario) as plant:
            simulate(plant, naive(scenario), 60, 0).write_csv(tmp_path / name)
        return (tmp_path / name).read_bytes()

    steady = run("steady.csv")
    jumps = lambda: float(rng.uniform(-1e9, 1e9))  # noqa: E731
    monkeypatch.setattr("cosim.core.simulation.perf_counter", jumps)
    monkeypatch.setattr("time.time", jumps)
    assert run("jumping.csv") == steady


# Plants ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tank(tmp_path_factory):
    return build_tank(tmp_path_factory.mktemp("tank"), saves=True)


def test_a_failing_plant_ends_the_run_in_one_line(tmp_path, tank):
    scenario = write_scenario(tmp_path, tank, fault=1)
    words = f"simulate -s {scenario} -c tests.helpers.loop:hold -n 5 --out out"
    said = refused(command_line(tmp_path, *words.split()))
    assert "returned x = nan at step 0" in said
    assert not list((tmp_path / "out").glob("*"))


# Solvers ---------------------------------------------------------------------------------------

SHARE = 0.01


class Unreliable(DaqpBackend):
    """DAQP that fails to solve 1 % of its problems, and counts."""

    injected = 0
    rng = np.random.default_rng(5)

    def solve(self, qp):
        if Unreliable.rng.random() < SHARE:
            Unreliable.injected += 1
            raise QpError("injected", status="injected", qp=qp.copy())
        return super().solve(qp)


@pytest.fixture
def unreliable(monkeypatch):
    monkeypatch.setattr(Unreliable, "injected", 0)
    monkeypatch.setattr(Unreliable, "rng", np.random.default_rng(5))
    return Unreliable


def test_a_run_goes_on_through_solver_failures_and_counts_each(unreliable):
    scenario = Scenario.load("paper")
    problem = Problem.from_scenario(scenario)
    controller = RtiNmpc(problem, Parameters.naive(problem), backend=unreliable)
    with FmuPlant(scenario) as plant:
        run = simulate(plant, controller, 3000, 0)
    failures = run.summary()["failures"]
    assert failures == unreliable.injected
    assert 10 < failures < 60
    # Where the solver failed, the action before was applied once more.
    failed = np.flatnonzero(run["failed"])
    np.testing.assert_array_equal(run.actions[failed], run.actions[failed - 1])
    assert run.status.count("fallback") == failures


def test_training_goes_on_through_solver_failures_and_counts_each(
    unreliable, interpreted, monkeypatch
):
    monkeypatch.setattr("controllers.rti.nmpc.make_backend", lambda name: unreliable())
    every = {"log_every": 500, "evaluate_every": 1000, "checkpoint_every": 1000}
    result = run_training(make_run(samples=1000, evaluation_steps=1, **every))
    assert result.status == "finished"
    failures = result.rows[-1]["failures"]
    # One-sample evaluations may fail too, and are not counted among the samples.
    assert unreliable.injected - 3 <= failures <= unreliable.injected
    assert failures > 5
