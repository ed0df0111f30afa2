"""The whole command on a tiny budget: the figures mean nothing, the files must repeat."""

import json

import pytest
from typer.testing import CliRunner

from cosim.cli.main import app
from cosim.reproduction.budget import BUDGETS, LITERAL, Budget, Learner

TINY = Budget(
    name="quick",
    learners=(
        Learner("q-learning-literal", "q-learning", 1000, LITERAL),
        Learner("q-learning", "q-learning", 1000),
    ),
    training_seeds=2,
    noise_seeds=2,
    steps=60,
    map_seeds=1,
    factorial=False,
)
TABLES = ("comparison.csv", "converged.csv", "map.csv", "evaluation.csv")


pytestmark = pytest.mark.slow


def reproduce(out, jobs):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BUDGETS, "quick", TINY)
        result = CliRunner().invoke(app, ["reproduce", "--out", str(out), "--jobs", str(jobs)])
    assert result.exit_code == 0, result.output + repr(result.exception)
    return {name: (out / name).read_bytes() for name in (*TABLES, "report.md")}


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reproduction")
    return folder, reproduce(folder, 1)


def test_twice_gives_identical_files_with_one_worker_or_two(once, tmp_path):
    assert reproduce(tmp_path, 2) == once[1]


def test_what_is_finished_is_not_done_again(once):
    folder, first = once
    trained = {path: path.stat().st_mtime_ns for path in folder.glob("training/*/learning.csv")}
    assert len(trained) == 2 * 2 + 5
    assert reproduce(folder, 1) == first
    assert {path: path.stat().st_mtime_ns for path in trained} == trained


def test_every_promised_part_is_there(once):
    folder, files = once
    summary = json.loads((folder / "summary.json").read_text())
    compared = {row["controller"] for row in summary["comparison"]}
    assert {"naive", "tuned", "converged", "optimal", "q-learning"} <= compared
    open_points = ("sampling_time", "discount", "law", "penalty_weight")
    assert len({tuple(row[name] for name in open_points) for row in summary["map"]}) == 6
    for name in ("q-learning", "q-learning-literal"):
        for suffix in ("png", "svg"):
            assert (folder / f"parameters-{name}.{suffix}").stat().st_size > 10_000
    assert "µs" not in files["report.md"].decode()
