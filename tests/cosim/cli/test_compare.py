import json

import pytest

from cosim import FmuPlant, Scenario, simulate
from tests.helpers.loop import Proportional


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folders s0 and s1 with runs of two seeds."""
    folder, scenario = tmp_path_factory.mktemp("runs"), Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        for seed in (0, 1):
            (folder / f"s{seed}").mkdir()
            trajectory = simulate(plant, Proportional(scenario), 30, seed)
            trajectory.write_csv(folder / f"s{seed}" / "trajectory.csv")
            trajectory.write_timing_csv(folder / f"s{seed}" / "timing.csv")
    return folder


@pytest.fixture
def runs(cosim, folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def test_equal_runs_end_with_0_and_others_with_1(cosim, runs):
    assert cosim("compare", "s0", "s0/trajectory.csv")[0] == 0
    code, out, err = cosim("compare", "s0", "s1")
    assert code == 1
    assert "P100" in out
    assert "first difference at sample 0 (time 0 s):\n  X1 differs by up to" in err


def test_tolerances_make_runs_equal(cosim, runs):
    assert cosim("compare", "s0", "s1", "--relative", "1e-9")[0] == 1
    assert cosim("compare", "s0", "s1", "--relative", "1e9")[0] == 0
    signals = json.loads(cosim("compare", "s0", "s1", "--json")[1])["signals"]
    options = [x for name, d in signals.items() for x in ("-t", f"{name}={d['maximum']}")]
    assert cosim("compare", "s0", "s1", *options)[0] == 0


def test_record_writes_an_overlay(cosim, runs):
    assert cosim("compare", "s0", "s1", "--record", "both.rrd")[0] == 1
    assert (runs / "both.rrd").stat().st_size > 10_000
