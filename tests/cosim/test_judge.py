"""Runs of other tools: the seed's noise by fmpy alone, and judged from CSV files."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from controllers.factories import tuned
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import EvaluationError
from cosim.core.simulation import indicators
from cosim.evaluation import judge
from tests.helpers.loop import Hold

ROOT = Path(__file__).parents[2]
SAMPLES = 30


@pytest.mark.parametrize("law", ["uniform", "normal"])
@pytest.mark.parametrize("fmu", ["evaporator", "evaporator_fmi3"])
def test_fmpy_alone_meets_the_benchmarks_noise(cosim, tmp_path, fmu, law):
    changes = {"plant": {"fmu": fmu}, "disturbance": {"law": law}}
    scenario = Scenario.load("paper").replace(changes)
    (tmp_path / "s.toml").write_text(scenario.to_toml())
    code, out, _ = cosim("scenario", "s.toml", "--seed-values", 3, "--json")
    assert code == 0
    starts = json.loads(out)["start_values"]
    assert starts["P2_start"] == scenario.initial_state[1]
    assert -(2**31) <= starts.get("seedHigh", 0) < 2**31
    (tmp_path / "start.json").write_text(out)
    command = [ROOT / "examples" / "fmpy_seed.py", ROOT / "fmus" / f"{fmu}.fmu", "start.json"]
    result = subprocess.run(
        [sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    rows = np.array([list(map(float, line.split(","))) for line in result.stdout.splitlines()])
    with FmuPlant(scenario) as plant:
        held = [float(v.start) for v in plant.unpacked.description.modelVariables
                if v.name in ("P100", "F200")]  # fmt: skip
        expected = simulate(plant, Hold(held), 20, 3)
    for column, name in enumerate(("X2", "P2", "X1", "F1"), start=1):
        np.testing.assert_array_equal(rows[:20, column], expected[name])


@pytest.fixture
def runs(tmp_path, paper):
    """Runs of `tuned` on seeds 4 and 5 as files, and their indicators."""
    folder, found = tmp_path / "runs", []
    folder.mkdir()
    with FmuPlant(paper) as plant:
        for seed in (4, 5):
            run = simulate(plant, tuned(paper), SAMPLES, seed)
            found.append(indicators(run))
            names = [*paper.plant.states, *paper.plant.actions]
            table = pd.DataFrame({f"{name} [unit]": run[name] for name in names})
            table.to_csv(folder / f"mine-{seed}.csv", index=False)
    return folder, found


def test_a_judged_run_has_the_indicators_of_the_loop(runs, paper):
    folder, found = runs
    table = judge(paper, folder)
    assert table["seed"].tolist() == [4, 5]
    for name in ("J", "economic_cost", "violating_share", "input_effort"):
        assert table[name].tolist() == pytest.approx([row[name] for row in found], rel=1e-12)
    assert (table["optimum"] > 0).all()


def test_other_noise_and_wrong_files_are_named(runs, paper):
    folder, _ = runs
    with pytest.raises(EvaluationError, match=r"mine-6.*at sample 1 is"):
        judge(paper, _only(folder, "mine-4.csv", "mine-6.csv", str))
    with pytest.raises(EvaluationError, match="beyond its bounds"):
        judge(paper, _only(folder, "mine-6.csv", "mine-4.csv", _strong))
    with pytest.raises(EvaluationError, match="name ends in its seed"):
        judge(paper, _only(folder, "mine-4.csv", "mine.csv", str))
    with pytest.raises(EvaluationError, match="no trajectory"):
        judge(paper, _only(folder, "mine.csv", "mine-4.csv", lambda text: text.replace("P100", "")))


def test_what_would_count_twice_or_unlike_is_refused(runs, paper):
    folder, _ = runs
    text = (folder / "mine-4.csv").read_text()
    for name, content, said in (
        ("copy-4.csv", text, "both of seed 4"),
        ("short-6.csv", "\n".join(text.splitlines()[:3]), "the same length"),
    ):
        (folder / name).write_text(content)
        with pytest.raises(EvaluationError, match=said):
            judge(paper, folder)
        (folder / name).unlink()
    # Without noise runs on two seeds may be one run.
    nominal = Scenario.load("nominal")
    for seed in (4, 5):
        with FmuPlant(nominal) as plant:
            simulate(plant, tuned(nominal), 3, seed).write_csv(folder / f"mine-{seed}.csv")
    with pytest.raises(EvaluationError, match="the same run as"):
        judge(nominal, folder)


def _strong(text):
    head, *rows = text.splitlines()
    return "\n".join([head, *(row.rpartition(",")[0] + ",1e6" for row in rows)])


def _only(folder, old, new, change):
    text = change((folder / old).read_text())
    for path in folder.iterdir():
        path.unlink()
    (folder / new).write_text(text)
    return folder


def test_the_command_judges_a_folder(cosim, runs):
    folder, found = runs
    code, out, err = cosim("evaluate", "--trajectories", folder, "--out", "judged", "--json")
    assert code == 0, err
    summary = json.loads(out)
    assert summary["J"]["value"] == pytest.approx(np.mean([row["J"] for row in found]), rel=1e-12)
