"""Outsiders in the benchmark's table, as their stored weights and θ."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cosim import StudyResults, evaluate
from examples.outsiders import policy

FOLDER = Path(__file__).parents[2] / "examples" / "outsiders"


def weights(path, W, last="none"):
    np.savez(path, layers=1, between="tanh", last=last, W0=W, b0=np.zeros(2))
    return path


def test_actions_stay_in_the_box(paper, tmp_path):
    agent = policy.NeuralPolicy(paper, weights(tmp_path / "large.npz", 1e3 * np.eye(2)))
    np.testing.assert_allclose(agent.feedback(np.array([30.0, 40.0])).action, [400.0, 100.0])


@pytest.mark.parametrize("name", ["sac", "ppo"])
def test_stored_policies_run_in_the_benchmark(paper, name):
    evaluation = evaluate(paper, {name: getattr(policy, name)}, 2, 100)
    assert np.isfinite(evaluation.column(name, "J")).all()
    assert (evaluation.column(name, "failures") == 0).all()


@pytest.mark.slow
def test_one_command_makes_the_study_of_policies_that_are_there(tmp_path):
    pytest.importorskip("stable_baselines3")
    for name in ("sac", "ppo"):
        shutil.copy(FOLDER / f"{name}.npz", tmp_path)
    few = ["--only", "sac,ppo", "--share", "0.01"]
    command = [sys.executable, FOLDER / "retrain.py", "--out", tmp_path, *few]
    subprocess.run(command, check=True, capture_output=True, text=True, cwd=tmp_path)
    assert (tmp_path / "study" / "report.html").stat().st_size > 10_000
    results = StudyResults.load(tmp_path / "study")
    assert set(results.cases) >= {"naive", "tuned", "sac", "ppo"}
    assert set(results.evaluation.steps) == {100}
