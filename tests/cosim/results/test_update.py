"""`cosim results update`: the one writer of a results folder, and what check says of its tables."""

import json

import pytest
from typer.testing import CliRunner

from cosim.cli.main import app
from cosim.errors import ResultsError

EXPERIMENTS = """\
[experiment.runs]
title = "Two runs"
quick = true
table = "trajectory.csv"
keys = ["time"]
drop = ["status", "residual"]
files = ["scenario.toml"]
figures = ["trajectory", "density", "phase"]
[experiment.runs.runs]
naive = "cosim simulate --controller naive --steps 40"
tuned = "cosim simulate --controller tuned --steps 40"

[experiment.compared]
title = "Comparison"
table = "evaluation.csv"
keys = ["controller", "seed"]
drop = [
  "scenario", "version", "versions", "code_hash", "scenario_hash", "fmu_sha256", "parameters_hash",
  "command",
]
figures = ["pareto"]
[experiment.compared.runs]
paper = "cosim evaluate --controllers naive,tuned --seeds 2 --steps 30 --jobs 1"
"""
NAMES = ("X2", "P2", "P100", "F200", "X1", "F1", "T1", "T200", "stage_cost", "penalty")
UNITS = ("%", "kPa", "kPa", "kg/min", "%", "kg/min", "degC", "degC", "1", "1")


def run(*arguments):
    return CliRunner().invoke(app, ["results", *map(str, arguments)])


def write(folder, experiments=EXPERIMENTS):
    folder.mkdir(parents=True)
    (folder / "experiments.toml").write_text(experiments)
    lines = [
        f'{n} = {{ absolute = 1e-6, unit = "{u}" }}\n' for n, u in zip(NAMES, UNITS, strict=True)
    ]
    lines += [f'{n} = {{ absolute = 0, unit = "" }}\n' for n in ("explored", "failed", "violation")]
    lines += ['value = { absolute = 1, unit = "1" }\n', '"*" = { absolute = 1, unit = "" }\n']
    (folder / "tolerances.toml").write_text("[tolerance]\n" + "".join(lines))
    return folder


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = write(tmp_path_factory.mktemp("stored") / "results")
    result = run("update", "--results", folder)
    assert result.exit_code == 0, result.output + repr(result.exception)
    return folder


def test_update_stores_table_files_figures_and_readme(stored):
    names = {path.name for path in (stored / "runs").iterdir()}
    figures = ("trajectory-naive", "trajectory-tuned", "density", "phase")
    assert names == {
        *("trajectory.csv", "naive-scenario.toml", "tuned-scenario.toml"),
        *("summary.json", "made.json"),
        *(f"{figure}.{suffix}" for figure in figures for suffix in ("png", "svg")),
    }
    text = (stored / "README.md").read_text()
    assert "cosim simulate --controller tuned --steps 40" in text
    assert "| tuned |" in text


def test_what_was_stored_checks_and_a_changed_number_does_not(stored):
    assert run("check", "--results", stored).exit_code == 0
    table = stored / "runs" / "trajectory.csv"
    text = table.read_text()
    row = next(line for line in text.splitlines() if line.startswith("tuned,60,"))
    run_, time, _, *others = row.split(",")
    try:
        table.write_text(text.replace(row, ",".join([run_, time, "26.5", *others])))
        result = run("check", "runs", "--results", stored)
    finally:
        table.write_text(text)
    assert result.exit_code == 1
    output = " ".join(result.output.split())
    assert "row run=tuned, time=60: signal X2 is " in output
    assert "26.5 stored" in output


@pytest.mark.slow
def test_update_repeats_its_bytes_but_for_recordings(stored, tmp_path):
    again = write(tmp_path / "results")
    assert run("update", "--results", again).exit_code == 0
    for path in stored.rglob("*"):
        if path.is_file() and ".work" not in path.parts:
            assert path.read_bytes() == (again / path.relative_to(stored)).read_bytes(), path.name


def test_summaries_have_the_tables_digits_and_no_clock(stored):
    summary = json.loads((stored / "runs" / "summary.json").read_text())["naive"]
    assert summary["J"] == float(f"{summary['J']:.8g}")
    assert "timing" not in summary


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("scenario.toml", "nothing.txt"), "wrote no nothing.txt"),
        (("trajectory.csv", "evaluation.csv"), "wrote no evaluation.csv"),
        (('keys = ["time"]', 'keys = ["explored"]'), "has two rows"),
        pytest.param(
            ("--steps 40", "--steps 9000"), "more than 1000000; take fewer", marks=pytest.mark.slow
        ),
    ],
)
def test_what_cannot_be_stored_is_named_and_leaves_no_table(tmp_path, change, message):
    folder = write(tmp_path / "results", EXPERIMENTS.replace(*change))
    result = run("update", "runs", "--results", folder)
    assert isinstance(result.exception, ResultsError)
    assert message in str(result.exception)
    assert not (folder / "runs" / "trajectory.csv").exists()
