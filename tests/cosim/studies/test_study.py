"""The engine: what is stored, resumed, repeated, counted, refused."""

import json
import shutil
from pathlib import Path

import pytest

from cosim import FmuPlant, Study, simulate, study
from cosim.core.errors import CosimError, FailedRunsError, StudyError
from cosim.studies.plan import plan
from cosim.studies.results import StudyResults
from tests.helpers.toy_study import SCENARIO, case, document, run_toy, toy_scenario

ROOT = Path(__file__).parents[3]
TABLES = ("evaluation.csv", "curves.csv", "runs.csv", "summary.csv", "study.json")


def contents(folder):
    return {name: (folder / name).read_bytes() for name in TABLES}


def stamps(folder, pattern):
    return {path: path.stat().st_mtime_ns for path in sorted(folder.glob(pattern))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    run_toy(folder)
    return folder


def test_every_case_scenario_and_seed_is_run_and_evaluated(whole):
    found = {path.parent.relative_to(whole / "runs").as_posix() for path in whole.rglob("run.json")}
    grown = {f"paper/grow(rate={rate})/{seed}" for rate in (1.0, 2.0) for seed in (0, 1)}
    assert found == {"paper/naive", "paper/optimal"} | grown
    assert not list(whole.rglob("checkpoint.npz"))


def test_a_run_s_indicators_are_those_of_its_own_closed_loop(whole):
    from controllers.factories import build_controller

    folder = whole / "runs" / "paper" / "grow(rate=2.0)" / "1"
    row = (folder / "evaluation.csv").read_text().splitlines()[2].split(",")
    with FmuPlant(toy_scenario()) as plant:
        theta = build_controller(str(folder / "parameters.toml"), plant.scenario)
        alone = simulate(plant, theta, 30, 100_001).summary()
    assert (row[0], float(row[3])) == ("100001", alone["J"])


@pytest.mark.slow
def test_a_training_that_was_interrupted_goes_on_from_its_checkpoint(tmp_path):
    def interrupted(out):
        toy = case(
            "c",
            "Interrupt",
            300,
            settings={"marker": str(tmp_path / "marker")},
            training={"checkpoint_every": 100, "log_every": 50, "evaluate_every": 100},
        )
        run_toy(out, case=[toy], training_seeds={"count": 1}, evaluation={"seeds": 1, "steps": 10})

    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "out")
    assert list((tmp_path / "out").glob("runs/*/*/*/checkpoint.npz"))
    interrupted(tmp_path / "out")
    interrupted(tmp_path / "undisturbed")
    assert contents(tmp_path / "out") == contents(tmp_path / "undisturbed")


def test_what_is_finished_is_not_done_again_and_more_seeds_are_added(whole, tmp_path):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    before = stamps(tmp_path, "runs/**/parameters.toml")
    more = {"training_seeds": {"first": 0, "count": 3}, "evaluation": {"seeds": 4, "steps": 30}}
    run_toy(tmp_path, **more)
    after = stamps(tmp_path, "runs/**/parameters.toml")
    assert len(after) == len(before) + 2
    assert before.items() <= after.items()
    for path in tmp_path.glob("runs/**/evaluation.csv"):
        assert len(path.read_text().splitlines()) == 1 + 4


@pytest.mark.slow
def test_a_changed_setting_is_named_and_trained_anew(tmp_path):
    lines = []

    def one(rate):
        run_toy(
            tmp_path,
            case=[case("g", samples=200, settings={"rate": rate})],
            training_seeds={"count": 1},
            report=lambda *state: lines.append(state[-1]),
        )
        return (tmp_path / "runs/paper/g/0/parameters.toml").read_text()

    first = one(1.0)
    lines.clear()
    assert one(3.0) != first
    assert "training changed since these runs; they are done again" in lines


def test_burn_in_is_run_and_not_counted(tmp_path):
    evaluation = {"seeds": 1, "steps": 20, "burn_in": 10}
    run_toy(tmp_path, case=[{"controller": "naive"}], evaluation=evaluation)
    row = (tmp_path / "runs/paper/naive/evaluation.csv").read_text().splitlines()[1].split(",")
    with FmuPlant(toy_scenario()) as plant:
        from controllers.factories import naive

        run = simulate(plant, naive(plant.scenario), 30, 100_000)
    cost = (run["stage_cost"] + run["penalty"])[10:].mean()
    assert row[:4] == ["100000", "20", "10", repr(float(cost))]


def test_runs_that_diverge_are_counted_as_they_do(tmp_path):
    states = []
    run_toy(
        tmp_path,
        case=[case("lost", "Diverge", samples=300)],
        training_seeds={"count": 1},
        report=lambda *state: states.append(state[1]),
    )
    assert "2/3 runs, 1 diverged" in states
    assert states[-1] == "3/3 runs, 1 diverged"


@pytest.mark.slow
def test_a_failing_case_is_told_at_once_and_the_others_are_done(tmp_path):
    lines = []
    with pytest.raises(FailedRunsError, match="ZeroDivisionError"):
        run_toy(
            tmp_path,
            case=[case("broken", "Break"), case("grow")],
            training_seeds={"count": 1},
            report=lambda *state: lines.append(state[-1]),
        )
    assert any(line.startswith("failed: broken on paper, seed 0") for line in lines)
    assert (tmp_path / "runs/paper/grow/0/evaluation.csv").is_file()
    trace = next(tmp_path.glob("runs/paper/broken/0/failure.txt")).read_text()
    assert "toy_study.py" in trace
    (line,) = {line for line in lines if line.startswith("failed: broken on paper, seed 0")}
    assert "toy_study.py:53, in observe: ZeroDivisionError" in line


def test_sizes_may_differ_by_scenario_and_a_scenario_be_written_in_the_study(tmp_path):
    run_toy(
        tmp_path,
        scenarios=["paper", "cheap"],
        scenario=[
            SCENARIO,
            SCENARIO | {"name": "cheap", "penalty": {"linear": [1e3, 1e3]}},
        ],
        evaluation={"seeds": {"default": 2, "cheap": 1}, "steps": {"paper": 10, "cheap": 15}},
        case=[{"controller": "naive"}],
    )
    sizes = {
        path.parts[-3]: [line.split(",")[1] for line in path.read_text().splitlines()[1:]]
        for path in tmp_path.glob("runs/*/naive/evaluation.csv")
    }
    assert sizes == {"paper": ["10", "10"], "cheap": ["15"]}


@pytest.mark.parametrize(
    "changes",
    [
        {"case": [{"name": "a"}]},
        {"case": [{"algorithm": "q-learning"}]},
        {"case": [{"controller": "naive", "samples": 5}]},
        {"cases": []},
        {"schema": 2},
        {"case": [{"controller": "naive"}] * 2},
        {"case": [{"name": "..", "controller": "naive"}]},
        {"case": [{"controller": "naive", "against": "tuned"}]},
        {"scenarios": ["papr"]},
        {"evaluation": {"first_seed": 1}},
        {"evaluation": {"first_seed": 1_000_000}},
        {"evaluation": {"steps": {"nominal": 3}}},
        {"evaluation": {"steps": {}}},
        {"case": [case("a", scenarios=["nominal"])]},
        {"case": [{"name": "a", "algorithm": "q-lerning"}]},
        {"case": [case("a", samples=[])]},
        {"case": [case("a", settings={"rat": 1.0})]},
        {"case": [case("a", training={"seed": 1})]},
        {"logs": ["nobody"]},
    ],
)
def test_a_mistake_is_refused_before_any_work(changes, tmp_path):
    # A search's settings are learning's own errors.
    from learning.errors import LearningError

    with pytest.raises((CosimError, LearningError)):
        run_toy(tmp_path, **changes)
    assert not list(tmp_path.rglob("run.json"))


# What is found in the folder --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("learning.csv", "torn"),
        ("parameters.toml", "edited before its evaluation"),
        ("evaluation.csv", "gone"),
        ("run.json", "torn"),
    ],
)
def test_a_finished_run_s_damaged_file_is_named_and_made_again(whole, tmp_path, name, damage):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "runs" / "paper" / "grow(rate=1.0)" / "0" / name
    content = path.read_bytes()
    if "before" in damage:  # as an interrupted study leaves it
        (path.parent / "evaluation.csv").unlink()
        about = json.loads((path.parent / "run.json").read_text())
        about["files"] = {name: about["files"][name] for name in ("learning.csv", path.name)}
        (path.parent / "run.json").write_text(json.dumps(about))
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(content[: len(content) // 2] + b"1\n" * damage.startswith("edited"))
    lines = []
    run_toy(tmp_path, report=lambda *state: lines.append(state[-1]))
    assert any(str(path) in line for line in lines)
    # run.json holds how long the run took.
    assert name == "run.json" or path.read_bytes() == content
    assert contents(tmp_path) == contents(whole)


def test_nothing_is_deleted_but_files_of_runs(tmp_path):
    precious = tmp_path / "runs" / "paper" / "naive" / "precious.txt"
    precious.parent.mkdir(parents=True)
    precious.write_text("mine")
    run_toy(tmp_path, case=[{"controller": "naive"}])
    about = json.loads((precious.parent / "run.json").read_text())
    about["facts"]["rti-cosim"] = "other"
    (precious.parent / "run.json").write_text(json.dumps(about))
    run_toy(tmp_path, case=[{"controller": "naive"}])
    assert precious.read_text() == "mine"


def test_a_run_s_folder_does_not_lead_elsewhere(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out" / "runs").mkdir(parents=True)
    (tmp_path / "out" / "runs" / "paper").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StudyError):
        run_toy(tmp_path / "out", case=[{"controller": "naive"}])


# The plan ---------------------------------------------------------------------------------------


def cases(**table):
    given = {"name": "c", "algorithm": case("")["algorithm"]} | table
    return Study.from_dict(document(case=[given]), "/study").cases


def test_lists_are_a_grid_and_name_what_varies():
    found = cases(settings={"rate": [1, 2], "marker": "x"}, start=["naive", "tuned"])
    assert [one.name for one in found] == [
        "c(start=naive rate=1)",
        "c(start=naive rate=2)",
        "c(start=tuned rate=1)",
        "c(start=tuned rate=2)",
    ]
    assert found[3].settings == {"rate": 2, "marker": "x"}


def test_files_are_seen_from_the_study():
    study = Study.from_dict(document(), "/study")
    assert [study.located(name) for name in ("mine.toml", "naive")] == [
        str(Path("/study/mine.toml")),
        "naive",
    ]
    found = cases(name=None, algorithm=None, controller=["theta/mine.toml", "module:make"])
    assert [(one.name, one.training_seeds) for one in found] == [("mine", ()), ("module.make", ())]
    assert found[0].controller == "theta/mine.toml"
    assert [one.name for one in cases(name="mine", algorithm=None, controller="naive")] == ["mine"]


def test_a_counterpart_is_that_of_the_same_point_of_the_grid():
    search = case("search", start=["naive", "tuned"])
    with_rule = case("rule", start=["naive", "tuned"], against="search")
    study = Study.from_dict(document(case=[search, with_rule]))
    found = {one.name: study.counterpart(one) for one in study.cases}
    assert found["rule(start=tuned)"] == "search(start=tuned)"
    assert found["search(start=tuned)"] is None


def moved(folder, start="clean"):
    """Facts of the runs of a study in a folder that holds its start."""
    folder.mkdir()
    shutil.copy(ROOT / "results" / "starts" / f"{start}.toml", folder / "start.toml")
    runs = [{"controller": "start.toml"}, case("q", start="start.toml")]
    found = plan(Study.from_dict(document(case=runs), folder))
    return {run.case: run.facts for run in found.runs}


def test_a_study_that_moved_keeps_its_runs_and_another_theta_at_the_start_is_another_run(tmp_path):
    here = moved(tmp_path / "here")
    assert here == moved(tmp_path / "there")
    changed = moved(tmp_path / "other", "fouled")
    assert {key for key in here if here[key] != changed[key]} == {"start", "q"}


def test_results_of_a_folder_are_those_that_were_returned(whole):
    again = study(document(), whole)
    assert StudyResults.load(whole).about == again.about
