"""What the runs of a study cost themselves: blocks, regret by period, and the figure."""

import csv

import numpy as np
import pandas as pd
import pytest

from controllers.factories import naive
from controllers.optimum import change_of, stored
from cosim import FmuPlant, Scenario, Study, simulate, train
from cosim.studies import run as engine
from cosim.studies.operation import dearest, judged, plant_at
from cosim.studies.plan import plan
from cosim.studies.results import StudyResults
from learning.errors import ConfigurationError
from tests.helpers.toy_study import GROW, case, document, run_toy

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


HOURS = {"hours": [1, 4], "columns": [4]}


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    out = tmp_path_factory.mktemp("operation")
    growing = {"name": "grow", "algorithm": GROW, "start": "tuned"}
    return run_toy(
        out,
        operation=HOURS | {"drawn": ["slow"]},
        curves={"points": 1, "seeds": 2, "steps": 20},
        case=[growing, growing | {"name": "slow", "settings": {"rate": 0.5}, "against": "grow"}],
    )


def table(results, name):
    return pd.read_csv(results.folder / name)


def test_a_life_costs_what_the_same_training_costs(lived):
    rows = table(lived, "operation.csv").query("case == 'grow' and training_seed == 1")
    log = train(GROW, "paper", 240, seed=1, start="tuned", log_every=60, evaluate_every=240,
                checkpoint_every=240, evaluation_seeds=1, evaluation_steps=5).log()  # fmt: skip
    assert rows.samples.tolist() == [60, 240]
    np.testing.assert_allclose(rows.J, [log["J"][0], log["J"].mean()], rtol=1e-12)
    assert rows.first_change.tolist()[1] == 100


def test_the_optimum_has_a_life_on_each_trainings_noise(lived):
    rows = table(lived, "operation.csv")
    found = judged(rows, table(lived, "greedy.csv"), "optimal")
    best = rows[rows.case == "optimal"]
    assert sorted(best.training_seed.unique()) == [0, 1]
    assert found.lives.life_regret.notna().all()
    # θ that nobody has moved yet is the same in all runs, so is its greedy cost.
    first = found.lives[found.lives.samples == 60]
    assert first.regret.nunique() == 1


def test_the_page_has_the_figure_and_a_table_of_each_kind(lived):
    titles = [title for title, _, _ in lived.further()]
    assert len(titles) == 4
    assert lived.figure("operation-paper").axes


def test_a_study_judged_once_has_no_course_to_draw(lived, monkeypatch):
    whole = lived._judged("paper")
    last = whole._replace(lives=whole.lives[whole.lives.samples == 240])
    monkeypatch.setattr(StudyResults, "_judged", lambda self, scenario: last)
    assert lived._operation("paper") is None


def test_the_dearest_samples_are_those_of_a_row():
    cost = np.r_[np.zeros(300), np.ones(100), np.zeros(300)]
    assert dearest(cost) == 1.0
    assert dearest(np.roll(cost, 50)[:340]) == pytest.approx(0.0)
    assert dearest(np.array([1.0, 3.0])) == 2.0


def test_the_plant_as_it_is_has_no_change_to_come():
    jump, drifting = Scenario.load("jump"), Scenario.load("drifting")
    after = plant_at(jump, 12_000 * 60.0)
    assert change_of(after) is None
    assert stored(after).gain == stored(Scenario.load("fouled")).gain
    fouled = plant_at(drifting, 3 * 86_400.0)
    assert change_of(fouled) is None
    assert fouled.plant.parameters["UA2"] < 6.84


def test_an_algorithm_that_puts_the_plant_back_is_refused():
    study = document(operation=HOURS, case=[case("search") | {"algorithm": "search"}])
    with pytest.raises(ConfigurationError, match="asks for a simulator"):
        plan(Study.from_dict(study))
