"""The stored results themselves: they hold, and small changes do not go unnoticed."""

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.cli.main import app

STORED = Path(__file__).parents[3] / "results"


def check(folder, *names):
    result = CliRunner().invoke(app, ["results", "check", *names, "--results", str(folder)])
    return result.exit_code, result.output


@pytest.fixture
def changed(tmp_path):
    """A copy of the stored results whose commands use another reading of the scenario `paper`."""

    def change(text):
        folder = tmp_path / "results"
        shutil.copytree(STORED, folder, ignore=shutil.ignore_patterns(".work", "*.rrd"))
        (tmp_path / "changed.toml").write_text(f'extends = "paper"\n{text}')
        document = folder / "experiments.toml"
        document.write_text(
            document.read_text().replace("--scenario paper", "--scenario changed.toml")
        )
        return folder

    return change


@pytest.mark.slow
def test_stored_results_hold():
    code, output = check(STORED)
    assert code == 0, output


def test_the_unchanged_copy_passes(changed):
    code, output = check(changed(""), "closed-loop")
    assert code == 0, output


@pytest.mark.parametrize(
    ("change", "signal"),
    [
        ("[plant.parameters]\nUA2 = 6.9084", "stage_cost"),
        ("[penalty]\nlinear = [1.01e5, 1.01e5]", "penalty"),
        pytest.param("[plant.parameters]\nlambda_ = 38.885", "X2", marks=pytest.mark.slow),
    ],
    ids=["UA2", "penalty weight", "lambda"],
)
def test_one_per_cent_in_plant_or_cost_fails_and_names_the_signal(changed, change, signal):
    code, output = check(changed(change), "closed-loop")
    assert code == 1
    assert f"signal {signal} " in output


def test_a_loose_qp_tolerance_fails_and_names_the_signal(changed, monkeypatch):
    monkeypatch.setattr("controllers.qp.daqp_backend.SETTINGS", {"primal_tol": 1e-2})
    code, output = check(changed(""), "closed-loop")
    assert code == 1
    assert "signal X2" in output


@pytest.mark.slow
def test_another_qp_solver_passes(changed):
    code, output = check(changed('[controller]\nbackend = "proxqp"'), "closed-loop")
    assert code == 0, output


def test_an_unknown_experiment_is_refused():
    result = CliRunner().invoke(app, ["results", "check", "closed-lop", "--results", str(STORED)])
    assert "did you mean" in str(result.exception).lower()


@pytest.mark.slow
def test_commands_run_where_the_results_are(changed):
    folder = changed("")
    before = Path.cwd()
    check(folder, "closed-loop")
    assert Path.cwd() == before
