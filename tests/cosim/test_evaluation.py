import json
import sys
import warnings

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, evaluate, simulate
from cosim.core.errors import CosimWarning, EvaluationError, ScenarioError
from cosim.evaluation import named_controllers
from cosim.workers import done
from tests.helpers.loop import Proportional, hold, proportional
from tests.helpers.workers import LEDGER, always_dying, mortal, noting, sluggish, warning

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


def test_a_sensor_that_is_late_is_evaluated_by_name():
    """The run that shows how long one takes is long enough for the first reading."""
    evaluation = evaluate("late", {"mine": "naive"}, 2, 40)
    assert len(evaluation.to_pandas()) == 2
    with pytest.raises(ScenarioError, match="never read"):
        evaluate("late", {"mine": "naive"}, 2, 15)


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


def test_short_work_of_our_own_code_starts_no_worker(paper, monkeypatch):
    alone = contents(evaluate(paper, ["naive"], 2, 20))
    monkeypatch.setattr("loky.ProcessPoolExecutor", None)
    assert contents(evaluate(paper, ["naive"], 2, 20, jobs=2)) == alone
    with pytest.raises(TypeError):
        evaluate(paper, {"hold": hold}, 2, 20, jobs=2)


def test_few_samples_of_others_code_are_work_for_more_than_one_worker(paper, monkeypatch):
    given = []

    def noting_items(items, *rest):
        given.extend(items)
        return done(items, *rest)

    monkeypatch.setattr("cosim.evaluation.done", noting_items)
    evaluate(paper, {"hold": hold}, 8, 50)
    assert [key for key in given if key[0] == "hold"] == [("hold", k) for k in range(8)]


def test_progress_is_shown_within_a_run(paper, monkeypatch):
    monkeypatch.setattr("cosim.workers.PROGRESS_SECONDS", 0.0)
    shown = []
    evaluate(paper, {"hold": hold}, 2, 1000, progress=lambda n, *_: shown.append(n))
    assert {500, 1000, 1500} < set(shown) and shown == sorted(shown)
    # Those of the optimum with them, whose J is J*.
    assert shown[-1] == 4000


@pytest.mark.slow
def test_workers_say_how_far_they_are_within_a_run(paper):
    shown = []
    evaluate(paper, {"sluggish": sluggish}, 2, 150, jobs=2, progress=lambda n, *_: shown.append(n))
    assert any(0 < n < 150 for n in shown)


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


@pytest.mark.slow
def test_what_every_worker_warns_of_is_said_once(paper, capfd, monkeypatch):
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("default")
        evaluate(paper, {"warning": warning, "again": warning}, 4, 20, jobs=2)
    ours = [each for each in shown if issubclass(each.category, CosimWarning)]
    assert [str(each.message) for each in ours] == ["this controller warns"]
    assert "this controller warns" not in capfd.readouterr().err


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


def test_a_learned_controller_has_the_name_of_its_folder():
    files = [
        "runs/mine/parameters.toml",
        "parameters.toml",
        "runs/other.toml",
        "a=b/parameters.toml",
    ]
    assert list(named_controllers(files)) == ["mine", "parameters", "other", "a"]


def test_a_printed_table_has_regret_in_per_cent_and_the_columns_asked_for(paper):
    evaluation = evaluate(paper, {"proportional": proportional, "optimal": "optimal"}, 2, 20)
    header, _, row, best = str(evaluation).splitlines()
    assert header.split(" | ")[1] == "regret %" and len(header.split(" | ")) == 6
    regret = 100 * (evaluation.column("proportional", "J") - evaluation.optimal).mean()
    regret /= evaluation.optimal.mean()
    assert float(row.split(" | ")[1].split()[0]) == pytest.approx(regret, rel=0.1)
    assert best.split(" | ")[1].startswith("0 ")
    assert evaluation.table(["controller", "J"]).startswith("| controller | J |")
    with pytest.raises(EvaluationError, match=r"no column 'regre' \(did you mean 'regret'"):
        evaluation.table(["regre"])


def test_pairs_have_one_interval_each(capsys):
    """A quotient's interval may leave out zero where that of the difference has it."""
    from cosim.cli.evaluate import _show_pairs
    from cosim.cli.output import Output

    difference = {"value": -28.0, "interval": (-71.0, 14.0)}
    gain = {"value": 0.5, "interval": (0.39, 0.62), "bootstrap": (0.39, 0.62)}
    comparison = {
        "controller": "mine",
        "reference": "naive",
        "differences": {"J": difference},
        "gain_in_J": gain,
    }
    _show_pairs({"comparisons": [comparison]}, Output(False))
    out = capsys.readouterr().out
    assert "[-71, 14]" in out and "50.0" in out and "39" not in out


def test_the_legend_goes_where_its_table_goes(capsys, paper):
    from cosim.cli.evaluate import show_evaluation
    from cosim.cli.output import Output

    evaluation = evaluate(paper, BOTH, 2, 20)
    show_evaluation(evaluation.summary(), Output(False), pairs=False)
    out, err = capsys.readouterr()
    assert "regret = (J − J*)/|J*|" in out and not err
