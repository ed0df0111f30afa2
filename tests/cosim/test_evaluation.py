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
from tests.helpers.loop import Proportional, hold, proportional
from tests.helpers.workers import LEDGER, always_dying, mortal, noting

BOTH = {"proportional": proportional, "hold": hold}


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


def test_a_finished_evaluation_is_read_not_run_again(paper, tmp_path, ledger):
    first = evaluate(paper, {"noting": noting}, 3, 20, folder=tmp_path / "out")
    runs = len(ledger())
    again = evaluate(paper, {"noting": noting}, 3, 20, folder=tmp_path / "out")
    assert (runs, len(ledger())) == (3, 3)
    assert contents(first) == contents(again)
    assert first.summary()["timing"] == again.summary()["timing"]


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


def test_a_killed_worker_loses_nothing(paper, tmp_path, ledger):
    broken = evaluate(paper, {"mortal": mortal}, 5, 20, folder=tmp_path / "out", jobs=2)
    assert len(ledger()) > 5, "no run was begun twice, so none was killed"
    whole = evaluate(paper, {"mortal": mortal}, 5, 20)
    assert contents(broken) == contents(whole)


def test_controllers_may_be_given_by_name(paper):
    named = evaluate(paper, ["naive"], 1, 5)
    assert contents(named) == contents(evaluate(paper, {"naive": naive}, 1, 5))
    for wrong in ("naive", ["naive", "naive"]):
        with pytest.raises(EvaluationError, match="a list of different names"):
            evaluate(paper, wrong, 1, 5)


def test_the_optimum_need_not_be_named_for_the_regret(paper):
    evaluation = evaluate(paper, {"mine": hold}, 3, 40)
    beside = evaluate(paper, {"mine": hold, "optimal": "optimal"}, 3, 40).summary()
    summary = evaluation.summary()
    assert {row["controller"] for row in evaluation.rows} == {"mine"}
    assert list(summary["controllers"]) == ["mine"]
    assert summary["optimal_J"] == beside["optimal_J"] == beside["controllers"]["optimal"]["J"]
    assert summary["controllers"]["mine"]["regret"] == beside["controllers"]["mine"]["regret"]
    for row in evaluation.rows:
        optimum = evaluation.optimal[row["seed"]]
        assert row["regret"] == pytest.approx((row["J"] - optimum) / optimum, abs=1e-15)


@pytest.mark.slow
def test_a_killed_evaluation_goes_on_where_it_stopped(tmp_path):
    root = str(Path(__file__).parents[2])
    environment = os.environ | {LEDGER: str(tmp_path / "ledger"), "PYTHONPATH": root}

    def command(out):
        controllers = "slow=tests.helpers.workers:slow"
        arguments = f"evaluate -c {controllers} --seeds 6 --steps 20000 --jobs 1 --out {out}"
        return [sys.executable, "-m", "cosim", *arguments.split()]

    rows = tmp_path / "out" / "runs" / "paper" / "slow" / "evaluation.csv"
    with subprocess.Popen(
        command(tmp_path / "out"), env=environment, stderr=subprocess.DEVNULL
    ) as process:
        deadline = time.monotonic() + 300
        while not rows.exists():
            assert process.poll() is None, "the run ended before it could be killed"
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    kept = rows.read_text().splitlines()
    assert 2 <= len(kept) < 7
    subprocess.run(command(tmp_path / "out"), env=environment, check=True, capture_output=True)
    assert rows.read_text().splitlines()[: len(kept)] == kept


def test_burn_in_is_run_and_not_counted(paper):
    evaluation = evaluate(paper, {"p": proportional}, 1, 20, burn_in=30)
    with FmuPlant(paper) as plant:
        run = simulate(plant, Proportional(paper), 50, 0)
    cost = run["stage_cost"] + run["penalty"]
    assert evaluation.rows[0]["J"] == cost[30:].mean()


def test_an_edited_controller_is_done_anew_and_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = tmp_path / "mine_edited.py"
    lines = []

    def cost(gain):
        module.write_text(
            "from tests.helpers.loop import Proportional\n"
            f"def make(scenario):\n    return Proportional(scenario, gain={gain})\n"
        )
        sys.modules.pop("mine_edited", None)
        note = lambda _, line: lines.append(line)  # noqa: E731
        table = evaluate(
            "paper", {"p": "mine_edited:make"}, 1, 30, folder=tmp_path / "out", progress=note
        )
        return table.rows[0]["J"]

    sys.dont_write_bytecode, before = True, sys.dont_write_bytecode
    try:
        assert cost(1.0) != cost(30.0)
    finally:
        sys.dont_write_bytecode = before
    assert [line for line in lines if "mine_edited" in line and "anew" in line]


def test_no_other_controller_can_be_the_optimum(paper):
    with pytest.raises(EvaluationError):
        evaluate(paper, {"optimal": "naive"}, 1, 5)


@pytest.mark.parametrize("name", ["..", "a/b"])
def test_a_name_that_leads_elsewhere_is_refused(paper, tmp_path, name):
    with pytest.raises(EvaluationError):
        evaluate(paper, {name: hold}, 1, 5, folder=tmp_path)


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
    ],
)
def test_a_malformed_request_is_refused(paper, controllers, seeds, steps):
    with pytest.raises(EvaluationError):
        evaluate(paper, controllers, seeds, steps)


def test_an_evaluation_draws_itself_to_the_same_bytes(paper, tmp_path):
    table = evaluate(paper, BOTH, 3, 20)
    first = table.plot(tmp_path / "a.png").read_bytes()
    assert table.plot(tmp_path / "b.png").read_bytes() == first
