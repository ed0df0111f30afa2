"""The engine with a trainer that learns nothing: what is stored, resumed, repeated and counted."""

import numpy as np
import pandas as pd
import pytest

from cosim import FmuPlant, simulate
from cosim.errors import FailedRunsError, StudyError
from cosim.study.results import StudyResults
from tests.helpers.loop import Proportional
from tests.helpers.toy_trainer import study

TABLES = ("evaluation.csv", "curves.csv", "runs.csv", "summary.csv", "study.json")


def contents(folder):
    return {name: (folder / name).read_bytes() for name in TABLES}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return study().run(folder)


def test_every_case_scenario_and_seed_is_run_and_evaluated(whole):
    keys = whole.runs[["case", "training_seed"]].itertuples(index=False)
    runs = [(case, None if pd.isna(seed) else seed) for case, seed in keys]
    assert set(runs) == {
        ("naive", None),
        ("best", None),
        *((f"grow(rate={rate})", seed) for rate in (1.0, 2.0) for seed in (0, 1)),
    }
    assert set(whole.evaluation.seed) == {100_000, 100_001, 100_002}
    assert len(whole.evaluation) == 3 * len(runs)
    assert np.isfinite(whole.evaluation.J).all()
    trained = whole.curves[(whole.curves.case == "grow(rate=1.0)")]
    assert trained[trained.training_seed == 0].samples.tolist() == [500, 1000, 1200]
    assert whole.of("grow(rate=1.0)", "paper").plant_samples.tolist() == [1207, 1207]


def test_results_read_back_are_those_that_were_returned(whole):
    again = StudyResults.load(whole.folder)
    assert again.about == whole.about
    for name in ("state", "evaluation", "curves"):
        pd.testing.assert_frame_equal(
            getattr(again, name), getattr(whole, name), check_dtype=False, check_exact=True
        )


def test_regret_is_paired_with_the_optimum_on_the_same_noise(whole):
    best, grown = (whole.indicator(case, "paper") for case in ("best", "grow(rate=2.0)"))
    expected = np.mean(grown[1] - best[0]) / np.mean(best)
    assert whole.regret("grow(rate=2.0)", "paper", [1]).value == pytest.approx(expected, rel=1e-12)
    assert whole.regret("best", "paper").value == 0.0
    assert whole.gap_closed("best", "paper").value == pytest.approx(1.0)


def test_two_workers_give_the_bytes_of_one(whole, tmp_path):
    study().run(tmp_path, jobs=2)
    assert contents(tmp_path) == contents(whole.folder)


def test_a_study_that_was_interrupted_goes_on_from_its_checkpoints(tmp_path):
    def interrupted(name):
        case = {
            "name": "c",
            "algorithm": "interrupt",
            "samples": 1600,
            "settings": {"marker": str(tmp_path / name)},
        }
        return study(case=[case])

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        interrupted("marker").run(out)
    assert list(out.glob("runs/*/*/*/checkpoint.npz"))
    interrupted("marker").run(out)
    undisturbed = tmp_path / "undisturbed"
    interrupted("marker").run(undisturbed)
    assert contents(out) == contents(undisturbed)
    assert not list(out.glob("runs/*/*/*/checkpoint.npz"))


def test_what_is_finished_is_not_done_again_and_more_seeds_are_added(tmp_path):
    study().run(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("runs/**/parameters.toml")}
    assert len(before) == 4
    results = study(training_seeds={"first": 0, "count": 3}, evaluation={"seeds": 4, "steps": 30})
    results = results.run(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(results.runs) == 2 + 2 * 3
    assert results.indicator("grow(rate=1.0)", "paper").shape == (3, 4)


def test_a_changed_setting_is_trained_anew(tmp_path):
    def one(rate):
        return study(case=[{"name": "g", "algorithm": "grow", "samples": 600, "settings": rate}])

    first = one({"rate": 1.0}).run(tmp_path).of("g", "paper").J.iloc[0]
    second = one({"rate": 30.0}).run(tmp_path).of("g", "paper").J.iloc[0]
    assert first != second


def test_a_diverged_run_counts_with_its_own_cost(tmp_path):
    case = {"name": "d", "algorithm": "diverge", "samples": 2000}
    results = study(case=[case]).run(tmp_path)
    run = results.of("d", "paper").iloc[1]
    assert (run.status, run.samples) == ("diverged: as told", 1000)
    with FmuPlant("paper") as plant:
        own = simulate(plant, Proportional(plant.scenario, gain=1.0 + 1), 30, 100_001)
    assert results.indicator("d", "paper")[1, 1] == own.summary()["J"]


def test_a_failing_case_is_told_at_once_and_the_others_are_done(tmp_path):
    cases = [
        {"name": "broken", "algorithm": "break", "samples": 600},
        {"name": "grow", "algorithm": "grow", "samples": 600},
    ]
    lines = []
    with pytest.raises(FailedRunsError, match="broken on paper, seed 0: ZeroDivisionError: broken"):
        study(case=cases).run(tmp_path, report=lambda _, line: lines.append(line))
    assert any(line.startswith("failed: broken on paper, seed 0") for line in lines)
    results = StudyResults.load(tmp_path)
    assert len(results.of("grow", "paper")) == 2
    assert results.of("broken", "paper").empty
    trace = next(tmp_path.glob("runs/paper/broken/0/failure.txt")).read_text()
    assert "toy_trainer.py" in trace


def test_sizes_may_differ_by_scenario(tmp_path):
    evaluation = {"seeds": {"default": 2, "nominal": 1}, "steps": {"paper": 10, "nominal": 15}}
    results = study(
        scenarios=["paper", "nominal"], evaluation=evaluation, case=[{"controller": "naive"}]
    ).run(tmp_path)
    own = results.evaluation[results.evaluation.case == "naive"].groupby("scenario")
    sizes = {name: (len(rows), rows.steps.iloc[0]) for name, rows in own}
    assert sizes == {"paper": (2, 10), "nominal": (1, 15)}


def test_a_scenario_may_be_written_in_the_study(tmp_path):
    own = [{"extends": "paper", "name": "cheap", "penalty": {"linear": [1e3, 1e3]}}]
    results = study(scenarios=["paper", "cheap"], scenario=own, case=[{"controller": "naive"}])
    assert results.scenarios["cheap"].penalty.linear == (1e3, 1e3)
    assert list(results.run(tmp_path).runs.scenario) == ["paper"] * 2 + ["cheap"] * 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"case": [{"name": "a"}]}, "case 'a': needs either algorithm or controller"),
        ({"case": [{"algorithm": "grow"}]}, "needs a name"),
        ({"case": [{"controller": "naive", "samples": 5}]}, "samples is for an algorithm"),
        ({"cases": []}, r"cases: unknown field \(did you mean 'case'\?\)"),
        ({"schema": 2}, "schema"),
        ({"case": [{"controller": "naive"}] * 2}, "two cases are called 'naive'"),
        ({"scenarios": ["papr"]}, "did you mean 'paper'"),
        ({"evaluation": {"first_seed": 1}}, "noise seed 1 is a training seed too"),
        ({"evaluation": {"first_seed": 1_000_000}}, "a seed of the curves too"),
        ({"evaluation": {"steps": {"nominal": 3}}}, "'nominal' is no scenario of the study"),
        ({"evaluation": {"steps": {}}}, "has no number for 'paper'"),
        (
            {"case": [{"name": "a", "algorithm": "grow", "scenarios": ["nominal"]}]},
            "'nominal' is none of the study's scenarios",
        ),
        ({"case": [{"name": "a", "algorithm": "grov"}]}, "unknown algorithm 'grov'"),
        ({"case": [{"name": "a", "algorithm": "grow", "samples": []}]}, "samples is empty"),
    ],
)
def test_a_mistake_is_named_before_any_work(changes, message, tmp_path):
    from cosim.errors import CosimError

    with pytest.raises(CosimError, match=message):
        study(**changes).run(tmp_path)
    assert not list(tmp_path.glob("runs/**/run.json"))


def test_a_damaged_file_is_named(tmp_path):
    study().run(tmp_path)
    damaged = next(tmp_path.glob("runs/paper/naive/evaluation.csv"))
    damaged.write_text("seed,steps\n1,x\n")
    with pytest.raises(StudyError, match=r"evaluation\.csv' is damaged; delete it"):
        study().run(tmp_path)
