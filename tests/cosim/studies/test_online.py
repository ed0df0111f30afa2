"""What the runs of a study cost themselves: blocks, regret by period, and the figure."""

import csv

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from cosim.studies import run as engine
from cosim.studies.results import StudyResults
from tests.helpers.toy_study import GROW, run_toy

ONLINE = {"block": 100, "period": 200, "signals": ["td_error"]}


def online(folder, jobs=1, **changes):
    case = [
        {"name": "grow", "algorithm": GROW, "samples": 200},
        {"controller": ["naive", "optimal"]},
    ]
    return run_toy(folder, jobs=jobs, online=ONLINE | changes, case=case, logs=["grow"])


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return online(tmp_path_factory.mktemp("online"))


def rows(results, case):
    with (results.folder / "online.csv").open(newline="") as stream:
        return [row for row in csv.DictReader(stream) if row["case"] == case]


def test_a_controller_runs_on_the_noise_of_every_training(results):
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        run = simulate(plant, naive(scenario), 200, seed=1)
    cost = (run.signals["stage_cost"].values + run.signals["penalty"].values).reshape(2, 100)
    found = [row for row in rows(results, "naive") if row["training_seed"] == "1"]
    assert [int(row["samples"]) for row in found] == [100, 200]
    np.testing.assert_array_equal([float(row["J"]) for row in found], cost.mean(axis=1))


def test_a_training_counts_with_its_own_samples(results):
    logs = [results.folder / "runs" / "paper" / "grow" / seed / "learning.csv" for seed in "01"]
    own = [
        row["J"] for log in logs for row in csv.DictReader(log.read_text().splitlines()) if row["J"]
    ]
    assert [row["J"] for row in rows(results, "grow")] == own


def test_the_table_pairs_each_run_with_the_optimum_on_its_noise(results):
    ((title, header, lines),) = results.further()
    assert "paper" in title
    own = np.array([float(row["J"]) for row in rows(results, "grow")]).reshape(2, 2).mean(axis=1)
    best = (
        np.array([float(row["J"]) for row in rows(results, "optimal")]).reshape(2, 2).mean(axis=1)
    )
    line = dict(zip(header, next(line for line in lines if line[0] == "grow"), strict=True))
    expected = 100 * (own - best).mean() / best.mean()
    assert float(line["regret %, mean [95 %]"].split()[0]) == pytest.approx(expected, rel=5e-3)
    assert float(line["worst"]) == pytest.approx(100 * (own / best - 1).max(), rel=5e-3)
    assert line["period 1"] == line["regret %, mean [95 %]"].split()[0]
    assert "0" in next(line for line in lines if line[0] == "optimal")


def test_the_report_has_table_and_figure_and_needs_no_runs(results, tmp_path):
    page = StudyResults.load(results.folder).report(tmp_path).read_text("utf-8")
    assert "own samples" in page
    assert 'alt="online-paper' in page


def test_a_run_that_goes_on_does_nothing_twice(results, monkeypatch):
    monkeypatch.setattr(engine, "perform", lambda *_: pytest.fail("was done"))
    again = online(results.folder)
    assert rows(again, "optimal")
