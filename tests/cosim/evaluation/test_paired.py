import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, evaluate, simulate
from cosim.errors import EvaluationError
from cosim.evaluation.parallel import run_all
from cosim.evaluation.store import FILE
from tests.helpers.loop import Proportional, hold, proportional
from tests.helpers.workers import LEDGER, die, mortal, noting

BOTH = {"proportional": proportional, "hold": hold}


def lines(folder):
    """Whole lines of a folder's finished units."""
    path = folder / FILE
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def contents(evaluation):
    return (
        evaluation.to_csv(),
        json.dumps(evaluation.summary()["controllers"]),
    )


@pytest.fixture
def ledger(tmp_path, monkeypatch):
    path = tmp_path / "ledger"
    monkeypatch.setenv(LEDGER, str(path))
    return lambda: path.read_text().split()


def test_rows_are_what_single_runs_give(paper):
    evaluation = evaluate(paper, BOTH, 3, 50)
    with FmuPlant(paper) as plant:
        alone = simulate(plant, Proportional(paper), 50, 2).summary()
    row = next(r for r in evaluation.rows if r["controller"] == "proportional" and r["seed"] == 2)
    assert len(evaluation.rows) == 6
    for name in ("economic_cost", "mean_violation", "violating_share", "J", "failures"):
        assert row[name] == alone[name]


def test_a_controller_against_itself_differs_by_nothing(paper):
    evaluation = evaluate(paper, {"a": proportional, "b": proportional}, 4, 50)
    (comparison,) = evaluation.summary()["comparisons"]
    for estimate in (*comparison["differences"].values(), comparison["gain_in_J"]):
        assert estimate == {"value": 0.0, "t": (0.0, 0.0), "bootstrap": (0.0, 0.0)}


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


def test_the_optimum_need_not_be_named_for_the_regret(paper):
    named = {"mine": hold}
    evaluation = evaluate(paper, named, 3, 40, optimum=proportional)
    beside = evaluate(paper, named | {"optimal": proportional}, 3, 40).summary()
    summary = evaluation.summary()
    assert {row["controller"] for row in evaluation.rows} == {"mine"}
    assert list(summary["controllers"]) == ["mine"]
    assert summary["optimal_J"] == beside["optimal_J"] == beside["controllers"]["optimal"]["J"]
    assert summary["controllers"]["mine"]["regret"] == beside["controllers"]["mine"]["regret"]
    assert "gap_closed" not in summary["controllers"]["mine"], "there is no naive controller"


def test_each_row_has_the_regret_of_its_seed(paper):
    evaluation = evaluate(paper, BOTH, 2, 40, optimum=hold)
    for row in evaluation.rows:
        optimum = evaluation.column("hold", "J")[row["seed"]]
        assert row["regret"] == pytest.approx((row["J"] - optimum) / optimum, abs=1e-15)


def test_two_workers_give_the_bytes_of_one(paper):
    assert contents(evaluate(paper, BOTH, 4, 40, jobs=2)) == contents(evaluate(paper, BOTH, 4, 40))


@pytest.fixture
def cluster(ledger):
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.mark.slow
def test_a_dask_cluster_of_two_processes_gives_the_bytes_of_one(paper, cluster):
    there = evaluate(paper, BOTH, 4, 40, scheduler=cluster)
    assert contents(there) == contents(evaluate(paper, BOTH, 4, 40))


@pytest.mark.slow
def test_a_killed_dask_worker_loses_nothing(paper, cluster, ledger):
    broken = evaluate(paper, {"mortal": mortal}, 5, 20, scheduler=cluster)
    assert len(ledger()) > 5, "no run was begun twice, so none was killed"
    assert contents(broken) == contents(evaluate(paper, {"mortal": mortal}, 5, 20))


@pytest.mark.slow
def test_a_cluster_whose_workers_always_die_ends_in_an_error(cluster):
    with pytest.raises(EvaluationError, match="workers of the cluster died again and again"):
        run_all(die, {"a": 1}.items(), print, scheduler=cluster)


def test_a_finished_evaluation_is_read_not_run_again(paper, tmp_path, ledger):
    first = evaluate(paper, {"noting": noting}, 3, 20, folder=tmp_path / "out")
    runs = len(ledger())
    again = evaluate(paper, {"noting": noting}, 3, 20, folder=tmp_path / "out")
    assert (runs, len(ledger())) == (3, 3)
    assert contents(first) == contents(again)
    assert first.timing_csv() == again.timing_csv()


def compiled_once_it_pays(scenario):
    """A controller whose functions are compiled after its second run."""
    controller = Proportional(scenario)
    controller.functions = "interpreted"
    reset = controller.reset

    def count():
        reset()
        if controller.resets == 3:  # the settling run may be one
            controller.functions = "compiled"

    controller.reset = count
    return controller


def test_timing_says_how_functions_were_computed_and_the_table_does_not(paper, tmp_path):
    named = {"compiling": compiled_once_it_pays, "without": proportional}
    for _ in range(2):  # the second one is read from the store
        evaluation = evaluate(paper, named, 3, 20, folder=tmp_path / "out")
        timing = evaluation.summary()["timing"]
        assert timing["compiling"]["functions"] == "compiled and interpreted"
        assert timing["without"]["functions"] is None
    assert "compiled" not in evaluation.to_csv()
    assert "interpreted" not in evaluation.to_csv()


def test_more_seeds_run_only_what_is_new(paper, tmp_path, ledger):
    evaluate(paper, {"noting": noting}, 2, 20, folder=tmp_path / "out")
    evaluate(paper, {"noting": noting}, 4, 20, folder=tmp_path / "out")
    assert len(ledger()) == 4


def test_another_scenario_takes_nothing_from_the_store(paper, tmp_path, ledger):
    evaluate(paper, {"noting": noting}, 2, 20, folder=tmp_path / "out")
    dearer = paper.replace({"penalty": {"linear": [1.01e5, 1e5]}})
    evaluate(dearer, {"noting": noting}, 2, 20, folder=tmp_path / "out")
    assert len(ledger()) == 4


def test_settling_is_measured_where_the_plant_comes_to_rest(paper):
    noisy = evaluate(paper, {"naive": naive}, 1, 20)
    assert np.isnan(noisy.settling["naive"])
    quiet = evaluate("nominal", {"naive": naive}, 1, 400)
    assert 0 < quiet.settling["naive"] < 400 * 60.0


def test_an_evaluation_draws_itself_to_the_same_bytes(paper, tmp_path):
    for optimum in (None, naive):
        table = evaluate(paper, BOTH, 3, 20, optimum=optimum)
        first = table.plot(tmp_path / "a.png").read_bytes()
        assert len(first) > 10_000
        assert table.plot(tmp_path / "b.png").read_bytes() == first
    one = evaluate(paper, {"naive": naive}, 1, 1)
    assert one.plot(tmp_path / "c.svg").stat().st_size > 1000


def test_a_damaged_unit_is_named(paper, tmp_path):
    evaluate(paper, {"hold": hold}, 1, 5, folder=tmp_path)
    (tmp_path / FILE).write_text("{\n")
    with pytest.raises(EvaluationError, match=r"line 1 of the finished work units '.*' is damaged"):
        evaluate(paper, {"hold": hold}, 1, 5, folder=tmp_path)


def test_a_killed_worker_loses_nothing(paper, tmp_path, ledger):
    broken = evaluate(paper, {"mortal": mortal}, 5, 20, folder=tmp_path / "out", jobs=2)
    assert len(ledger()) > 5, "no run was begun twice, so none was killed"
    whole = evaluate(paper, {"mortal": mortal}, 5, 20)
    assert contents(broken) == contents(whole)


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_stopped(tmp_path):
    root = str(Path(__file__).parents[3])
    environment = os.environ | {LEDGER: str(tmp_path / "ledger"), "PYTHONPATH": root}

    def command(out):
        controllers = "slow=tests.helpers.workers:slow"
        arguments = f"evaluate -c {controllers} --seeds 6 --steps 100 --jobs 1 --out {out}"
        return [sys.executable, "-m", "cosim", *arguments.split()]

    out = tmp_path / "out"
    with subprocess.Popen(command(out), env=environment, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 60
        while len(lines(out)) < 2:
            assert process.poll() is None, "the run ended before it could be killed"
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    kept = lines(out)
    assert 2 <= len(kept) < 7
    assert not (out / "evaluation.csv").exists()
    subprocess.run(command(out), env=environment, check=True, capture_output=True)
    assert lines(out)[: len(kept)] == kept
    assert len(lines(out)) == 12, "six of the controller, six of the optimum"
    subprocess.run(command(tmp_path / "whole"), env=environment, check=True, capture_output=True)
    whole = tmp_path / "whole" / "evaluation.csv"
    assert (out / "evaluation.csv").read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    ("controllers", "seeds", "steps", "message"),
    [
        ({}, 1, 1, "no controller"),
        (BOTH, 0, 1, "no seed"),
        (BOTH, [1, 1], 1, "seeds must be distinct"),
        (BOTH, [-1], 1, "not negative"),
        (BOTH, 1, 0, "steps must be at least 1, not 0"),
    ],
)
def test_a_malformed_request_is_refused(paper, controllers, seeds, steps, message):
    with pytest.raises(EvaluationError, match=message):
        evaluate(paper, controllers, seeds, steps)


def test_controllers_may_be_given_by_name(paper):
    named = evaluate(paper, ["naive"], 1, 5)
    assert contents(named) == contents(evaluate(paper, {"naive": naive}, 1, 5))
    for wrong in ("naive", ["naive", "naive"]):
        with pytest.raises(EvaluationError, match="a list of different names"):
            evaluate(paper, wrong, 1, 5)
