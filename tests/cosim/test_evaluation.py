import json
import os
import sys

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, evaluate, simulate
from cosim.core.errors import EvaluationError
from cosim.measurement import MeasureItem, Noise
from cosim.workers import Conditions
from tests.helpers.loop import Proportional, hold, proportional
from tests.helpers.workers import LEDGER, always_dying, mortal, noting

BOTH = {"proportional": proportional, "hold": hold}


def contents(evaluation):
    return (evaluation.to_csv(), json.dumps(evaluation.summary()["controllers"]))


@pytest.fixture
def ledger(tmp_path, monkeypatch):
    path = tmp_path / "ledger"
    monkeypatch.setenv(LEDGER, str(path))
    return lambda: path.read_text().split()


def test_rows_are_what_single_runs_give(paper):
    evaluation = evaluate(paper, BOTH, 3, 50)
    with FmuPlant(paper) as plant:
        alone = simulate(plant, Proportional(paper), 50, 2).summary()
    rows = evaluation.to_pandas()
    row = rows.set_index(["controller", "seed"]).loc["proportional", 2]
    assert len(rows) == 6
    for name in ("economic_cost", "mean_violation", "violating_share", "J", "failures"):
        assert row[name] == alone[name]


def test_gain_and_gap_are_taken_against_naive_and_optimal(paper):
    named = {"optimal": proportional, "naive": hold, "mine": proportional}
    evaluation = evaluate(paper, named, 3, 100)
    summary = evaluation.summary()
    gap = {name: row["gap_closed"]["value"] for name, row in summary["controllers"].items()}
    assert gap == pytest.approx({"optimal": 1.0, "naive": 0.0, "mine": 1.0})
    cost = {name: np.mean(evaluation.column(name, "J")) for name in named}
    gain = next(
        c["gain_in_J"]["value"]
        for c in summary["comparisons"]
        if (c["controller"], c["reference"]) == ("mine", "naive")
    )
    assert gain == pytest.approx(1.0 - cost["mine"] / cost["naive"], rel=1e-12)


def test_two_workers_give_the_bytes_of_one(paper):
    assert contents(evaluate(paper, BOTH, 4, 40, jobs=2)) == contents(evaluate(paper, BOTH, 4, 40))


def test_work_of_seconds_starts_no_worker(paper, ledger):
    small = evaluate(paper, {"noting": "tests.helpers.workers:noting"}, 3, 20, jobs=2)
    assert set(ledger()) == {str(os.getpid())}
    assert len(ledger()) == 3
    assert contents(small) == contents(evaluate(paper, {"noting": noting}, 3, 20))


@pytest.mark.slow
def test_a_slow_plant_is_split_among_workers_after_its_first_seed(paper, ledger):
    split = evaluate(paper, {"slow": "tests.helpers.workers:slow"}, 8, 25, jobs=2)
    first, *others = ledger()
    assert first == str(os.getpid())
    assert first not in others
    assert len(set(others)) == 2, "one of the workers had nothing to do"
    assert contents(split) == contents(evaluate(paper, {"slow": noting}, 8, 25))


def test_items_are_sized_by_the_seconds_of_a_seed(paper):
    conditions = Conditions.of_now(paper)
    item = MeasureItem(conditions, hold, Noise(tuple(range(50)), 40), 40)
    for seconds, most in ((3.0, 1), (0.1, 10), (1e-6, 50), (0.0, 50), (None, 7)):
        parts = [part.noise.seeds for part in item.timed_parts(seconds)]
        assert max(map(len, parts)) == most
        assert sum(parts, ()) == item.noise.seeds


def test_every_evaluation_computes_and_writes_its_tables(paper, tmp_path, ledger):
    first = evaluate(paper, {"noting": noting}, 2, 20, folder=tmp_path / "out")
    again = evaluate(paper, {"noting": noting}, 3, 20, folder=tmp_path / "out")
    assert len(ledger()) == 5
    assert again.to_pandas()[again.to_pandas().seed < 2].J.tolist() == first.to_pandas().J.tolist()
    assert (tmp_path / "out" / "evaluation.csv").read_text() == again.to_csv()
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"evaluation.csv", "evaluation.png", "timing.csv", "scenario.toml"}


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(paper, ledger):
    broken = evaluate(paper, {"mortal": mortal}, 5, 20, jobs=2)
    assert len(ledger()) > 5, "no run was begun twice, so none was killed"
    whole = evaluate(paper, {"mortal": mortal}, 5, 20)
    assert contents(broken) == contents(whole)


def test_controllers_may_be_given_by_name(paper):
    named = evaluate(paper, ["naive"], 1, 5)
    assert contents(named) == contents(evaluate(paper, {"naive": naive}, 1, 5))
    for wrong in ("naive", ["naive", "naive"]):
        with pytest.raises(EvaluationError, match="controllers"):
            evaluate(paper, wrong, 1, 5)


def test_the_optimum_need_not_be_named_for_the_regret(paper):
    evaluation = evaluate(paper, {"mine": hold}, 3, 40)
    beside = evaluate(paper, {"mine": hold, "optimal": "optimal"}, 3, 40).summary()
    summary = evaluation.summary()
    assert set(evaluation.to_pandas().controller) == {"mine"}
    assert list(summary["controllers"]) == ["mine"]
    assert summary["optimal_J"] == beside["optimal_J"] == beside["controllers"]["optimal"]["J"]
    assert summary["controllers"]["mine"]["regret"] == beside["controllers"]["mine"]["regret"]
    found, best = evaluation.to_pandas(), evaluation.optimal
    np.testing.assert_allclose(found.regret, (found.J - best) / best, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_a_worker_that_always_dies_ends_in_an_error(paper):
    with pytest.raises(EvaluationError, match="died 3 times"):
        evaluate(paper, {"dying": always_dying}, 2, 5, jobs=2)


def test_a_plug_in_that_exits_ends_in_an_error(paper):
    def exiting(scenario):
        controller = Proportional(scenario)
        controller.prepare = sys.exit
        return controller

    with pytest.raises((SystemExit, EvaluationError)):
        evaluate(paper, {"exiting": exiting}, 1, 5)


@pytest.mark.parametrize(
    ("controllers", "seeds", "steps"),
    [
        ({}, 1, 1),
        (BOTH, 0, 1),
        (BOTH, [1, 1], 1),
        (BOTH, [-1], 1),
        (BOTH, [1 << 64], 1),
        (BOTH, 1, 0),
        ({"optimal": "naive"}, 1, 1),
    ],
)
def test_a_malformed_request_is_refused(paper, controllers, seeds, steps):
    with pytest.raises(EvaluationError):
        evaluate(paper, controllers, seeds, steps)
