"""Foreign native code may end or spoil the process: never exit code 0 without results."""

import json
import signal
import time
from pathlib import Path

import pytest

from tests.helpers.command import run_cosim, start_cosim
from tests.helpers.kinds import build_kind, scenario_for


@pytest.fixture(params=[2, 3], ids=["fmi2", "fmi3"])
def fmu(request, tmp_path):
    return build_kind(tmp_path, request.param)


def command(folder, fmu, fault, *more):
    """Words and environment of a run."""
    scenario = scenario_for(folder, fmu, fault=fault)
    words = ["simulate", "-s", scenario, "-c", "tests.helpers.loop:hold", "-n", 3, "--out", "out"]
    return [*words, *more], {"PYTHONPATH": str(Path(__file__).parents[3])}


def run(folder, fmu, fault, *more):
    words, environment = command(folder, fmu, fault, *more)
    return run_cosim(*words, folder=folder, env=environment)


def test_an_fmu_that_exits_is_one_line_and_exit_code_2(tmp_path):
    result = run(tmp_path, build_kind(tmp_path, 2), 3)
    assert result.returncode == 2
    assert "with exit code 0 before the command finished" in result.stderr
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (4, "with exit code 0 before the command finished"),
        (8, "by SIGKILL before the command finished"),
        (9, "by SIGSEGV before the command finished"),
    ],
    ids=["_exit", "kill", "crash"],
)
def test_an_fmu_that_ends_the_process_is_one_line_and_exit_code_2(tmp_path, fmu, fault, words):
    result = run(tmp_path, fmu, fault)
    assert result.returncode == 2
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert words in line
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.slow
def test_a_sigterm_from_within_unwinds(tmp_path, fmu):
    result = run(tmp_path, fmu, 7)
    assert result.returncode == 143
    assert not (tmp_path / "out" / "summary.json").exists()


@pytest.mark.slow
def test_an_fmu_that_goes_elsewhere_writes_results_where_they_belong(tmp_path, fmu):
    result = run(tmp_path, fmu, 5)
    assert result.returncode == 0, result.stderr
    assert {"summary.json", "trajectory.csv"} <= {p.name for p in (tmp_path / "out").iterdir()}


@pytest.mark.slow
def test_an_fmu_that_closes_everything_has_no_exit_code_0_without_results(tmp_path, fmu):
    result = run(tmp_path, fmu, 6)
    assert result.returncode != 0 or (tmp_path / "out" / "summary.json").exists()


@pytest.mark.slow
def test_a_thread_that_outlives_the_plant_spoils_no_results(tmp_path, fmu):
    result = run(tmp_path, fmu, 10)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "out" / "summary.json").exists()


def test_json_and_notes_come_through_the_watching_process(tmp_path):
    fmu = build_kind(tmp_path, 2)
    result = run(tmp_path, fmu, 0, "--json")
    assert json.loads(result.stdout)["samples"] == 3
    noted = run(tmp_path, fmu, 0)
    assert noted.stderr.count("native code of") == 1


@pytest.mark.slow
def test_the_watched_process_ends_with_the_watching_one(tmp_path, fmu):
    words, environment = command(tmp_path, fmu, 12)
    with start_cosim(*words, folder=tmp_path, env=environment) as process:
        assert "native code of" in process.stderr.readline()
        process.send_signal(signal.SIGKILL)
        process.wait()
        # The watched process holds the other end of the pipe until it ends, too.
        begin = time.monotonic()
        process.stderr.read()
        assert time.monotonic() - begin < 30.0
