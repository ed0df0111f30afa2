"""The stored studies themselves: they hold, and small changes do not go unnoticed."""

import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from cosim import Study, StudyResults
from cosim.cli.main import app
from cosim.core.training_options import HELD_OUT
from cosim.studies.run import read_table
from cosim.studies.stored import stored_studies

STORED = Path(__file__).parents[3] / "results"
MINIMAL = """\
schema = 1
name = "mini"
scenarios = ["paper"]
evaluation = { seeds = 2, steps = 30 }
check = true
[[scenario]]
extends = "paper"
name = "paper"
controller.horizon = 2
[[case]]
controller = ["naive", "tuned"]
[[trajectory]]
name = "loop"
steps = 40
figures = ["overlay"]
"""


def run(*arguments):
    return CliRunner().invoke(app, ["results", *map(str, arguments)])


def check(folder, *names):
    result = run("check", *names, "--results", folder, "--jobs", 1)
    return result.exit_code, " ".join(result.output.split())


@pytest.fixture(scope="module")
def mini(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mini") / "results"
    folder.mkdir()
    (folder / "mini.toml").write_text(MINIMAL)
    shutil.copy(STORED / "tolerances.toml", folder)
    result = run("update", "--results", folder, "--jobs", 1)
    assert result.exit_code == 0, result.output + repr(result.exception)
    return folder


@pytest.fixture
def changed(mini, tmp_path):
    """A copy of stored results whose study uses another reading of the scenario `paper`."""

    def change(text):
        folder = tmp_path / "results"
        shutil.copytree(mini, folder, ignore=shutil.ignore_patterns(".work"))
        document = (folder / "mini.toml").read_text()
        (folder / "mini.toml").write_text(document.replace("[[case]]", f"{text}\n[[case]]", 1))
        return folder

    return change


def test_every_stored_study_is_a_valid_study_that_can_be_planned():
    studies = stored_studies(STORED)
    assert {"closed-loop", "learning", "quick", "reproduce", "reproduce-full"} <= set(studies)
    assert all(table.name == name for name, table in studies.items())
    assert [name for name, table in studies.items() if table.check] == [
        "closed-loop",
        "gate",
        "regression",
    ]


FEW_ON_PURPOSE = {
    "before-after": "pictures of two runs",
    "converged": "a converged NMPC takes a thousand times as long",
    "quick": "it says itself that it ranks nothing",
    "reproduce": "minutes of a user's time",
    "reproduce-full": "it evaluates a converged NMPC, too",
}
"""Studies with fewer noise seeds than figures need that rank cases."""


COMPARED = {"operation-headline": "operation-intercept"}
"""Studies whose rows stand in one picture: what is compared meets the same noise."""


def test_each_study_has_noise_of_its_own_that_no_training_meets_and_enough_of_it():
    """A θ's mean cost is of rare events: noise that all studies share errs in all in one way."""
    used = {}
    for name, table in stored_studies(STORED).items():
        # Those hold digits and rank nothing; their tables are of the noise that they have.
        if table.check:
            continue
        study = Study.load(STORED / f"{name}.toml")
        trained = {seed for case in study.cases for seed in case.training_seeds}
        assert max(trained, default=0) < HELD_OUT
        seeds = set()
        for scenario in study.scenarios:
            noise = study.noise(scenario)
            seeds |= set(noise.seeds)
            if name not in FEW_ON_PURPOSE:
                assert len(noise.seeds) >= 30 and len(noise.seeds) * noise.steps >= 250_000, name
                assert not study.marks(scenario) or study.noise_at_marks(scenario) == noise
        assert min(seeds) > 2 * HELD_OUT
        owner = COMPARED.get(name, name)
        for seed in seeds:
            assert used.setdefault(seed, owner) == owner, f"{name} and {used[seed]} share {seed}"


def test_what_was_stored_checks(mini):
    code, output = check(mini)
    assert code == 0, output


def test_a_stored_study_s_figures_are_drawn_from_its_tables(mini, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(mini, folder, ignore=shutil.ignore_patterns(".work"))
    result = run("draw", "mini", "--results", folder)
    assert result.exit_code == 0, result.output + repr(result.exception)
    linked = re.findall(r"\]\((figures/.*?)\)", (folder / "mini" / "report.md").read_text())
    assert {"figures/overlay-paper-loop.svg", "figures/regret-paper.svg"} <= set(linked)
    drawn = [path.relative_to(folder / "mini").as_posix() for path in folder.rglob("*.svg")]
    assert sorted(drawn) == sorted(linked)


def test_reports_are_made_anew_from_the_stored_measurements_alone(mini, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(mini, folder, ignore=shutil.ignore_patterns(".work"))
    made = ("mini/summary.csv", "mini/report.md", "README.md")
    summary = pd.read_csv(folder / "mini" / "summary.csv", dtype=str)
    summary["J_median"] = "1.0"
    summary.to_csv(folder / "mini" / "summary.csv", index=False)
    for name in made[1:]:
        (folder / name).write_text("stale")
    before = {path for path in folder.rglob("*") if path.is_file()}
    result = run("report", "mini", "--results", folder)
    assert result.exit_code == 0, result.output + repr(result.exception)
    for name in made:
        assert (folder / name).read_text("utf-8") == (mini / name).read_text("utf-8"), name
    assert {path for path in folder.rglob("*") if path.is_file()} == before


def test_a_report_of_a_stored_study_without_its_figures_says_so(mini, tmp_path):
    folder = tmp_path / "mini"
    shutil.copytree(mini / "mini", folder)
    before = (folder / "report.md").read_text()
    page = StudyResults.load(folder).report().read_text("utf-8")
    assert "overlay-paper-loop is not drawn" in page
    assert 'alt="regret-paper"' in page
    assert (folder / "report.md").read_text() == before


def test_update_stores_tables_report_and_readme(mini):
    names = {path.relative_to(mini / "mini").as_posix() for path in (mini / "mini").rglob("*.*")}
    assert {
        *("evaluation.csv", "curves.csv", "runs.csv", "summary.csv", "study.json", "report.md"),
        *("trajectories/loop/paper/naive.csv", "trajectories/loop/paper/optimal.csv"),
    } <= names
    assert not {name for name in names if name.startswith(("runs/", "figures/"))}
    assert not {name for name in names if "timing" in name}
    assert "| tuned |" in (mini / "README.md").read_text()


@pytest.mark.parametrize(
    ("change", "signal"),
    [
        ("plant.parameters = { UA2 = 6.9084 }", "stage_cost"),
        ("penalty = { linear = [1.01e5, 1.01e5] }", "penalty"),
    ],
    ids=["UA2", "penalty weight"],
)
def test_one_per_cent_in_plant_or_cost_fails_and_names_the_signal(changed, change, signal):
    code, output = check(changed(change))
    assert code == 1
    assert f"signal {signal} " in output


def test_a_loose_qp_tolerance_fails_and_names_the_signal(changed, monkeypatch):
    monkeypatch.setattr("controllers.qp.DAQP_SETTINGS", {"primal_tol": 1e-2})
    code, output = check(changed(""))
    assert code == 1
    assert "signal X2" in output


@pytest.mark.slow
def test_another_qp_solver_passes(changed):
    code, output = check(changed('controller.backend = "proxqp"'))
    assert code == 0, output


def test_a_changed_number_is_named_with_its_row(mini, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(mini, folder, ignore=shutil.ignore_patterns(".work"))
    table = folder / "mini" / "trajectories" / "loop" / "paper" / "tuned.csv"
    lines = table.read_text().splitlines()
    row = lines[2].split(",")
    table.write_text("\n".join([*lines[:2], ",".join([row[0], "26.5", *row[2:]]), *lines[3:], ""]))
    code, output = check(folder)
    assert code == 1
    assert "mini/trajectories/loop/paper/tuned.csv: row time=60: signal X2 is" in output
    assert "26.5 stored" in output


def test_a_row_or_table_that_is_gone_is_named(mini, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(mini, folder, ignore=shutil.ignore_patterns(".work"))
    table = folder / "mini" / "evaluation.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:-1], ""]))
    code, output = check(folder)
    assert code == 1
    assert "is computed but not stored" in output
    table.unlink()
    assert isinstance(run("check", "--results", folder, "--jobs", 1).exception, Exception)


@pytest.mark.slow
def test_update_repeats_its_bytes(mini, tmp_path):
    again = tmp_path / "results"
    again.mkdir()
    for name in ("mini.toml", "tolerances.toml"):
        shutil.copy(mini / name, again)
    assert run("update", "--results", again, "--jobs", 2).exit_code == 0
    for path in (mini / "mini").rglob("*.*"):
        assert path.read_bytes() == (again / path.relative_to(mini)).read_bytes(), path.name


PAPER = """\
schema = 1
name = "reproduce"
scenarios = ["paper", "cheap"]
training_seeds = { count = 1 }
evaluation = { seeds = 2, steps = 30 }
curves = { points = 2, seeds = 1, steps = 20 }
logs = ["q"]
tables = ["paper"]
[[scenario]]
extends = "paper"
name = "cheap"
penalty = { linear = [1e3, 1e3] }
[[case]]
controller = ["naive", "tuned"]
[[case]]
name = "q"
algorithm = "q-learning"
samples = 400
"""


@pytest.mark.slow
def test_the_reproduction_is_a_study_with_the_paper_s_table_and_figure(tmp_path, monkeypatch):
    (tmp_path / "reproduce.toml").write_text(PAPER)
    monkeypatch.setattr("cosim.studies.stored.stored_results", lambda: tmp_path)
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["reproduce", "--out", str(out), "--jobs", "1"])
    assert result.exit_code == 0, result.output + repr(result.exception)
    report = (out / "report.md").read_text()
    assert "| cheap | q |" in report
    # It ends with the answer: too short a study reproduces nothing.
    claim, found, verdict = result.output.strip().splitlines()[-3:]
    assert claim.startswith("claim") and "21 %" in claim
    assert found.startswith("found") and "q on " in found
    assert verdict.startswith("verdict") and "not reproduced: none is within 3 %" in verdict
    for name in ("parameters-paper-q", "parameters-cheap-q"):
        assert (out / "figures" / f"{name}.png").stat().st_size > 10_000
        assert f'alt="{name}"' in (out / "report.html").read_text()
    log = read_table(out / "logs" / "paper-q.csv")
    assert log["samples"][0] == 0, "increments of θ are counted from its start"
