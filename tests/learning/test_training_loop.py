import subprocess
import sys
import time

import numpy as np
import pytest

from cosim import FmuPlant
from learning.errors import CheckpointError, ConfigurationError
from learning.log import to_csv
from learning.registry import load_algorithm
from learning.training_loop import TrainingLoop
from learning.training_run import TrainingRun

SETTINGS = {
    "q-learning": {"warm_up": 20},
    "batch-q-learning": {"batch_size": 50, "buffer_size": 100},
    "actor-critic": {"batch_size": 80},
}


def make_run(scenario, name, **changes):
    algorithm = load_algorithm(name)
    values = {
        "algorithm": name,
        "scenario": scenario,
        "samples": 450,
        "seed": 3,
        "configuration": algorithm.Configuration.from_dict(SETTINGS[name]),
        "log_every": 50,
        "evaluate_every": 100,
        "checkpoint_every": 100,
        "evaluation_seeds": 1,
        "evaluation_steps": 20,
    }
    return TrainingRun(**{**values, **changes}), algorithm


def train(run, algorithm, out=None, *, resume=False, progress=None):
    with FmuPlant(run.scenario) as plant, FmuPlant(run.scenario) as other:
        return TrainingLoop(run, algorithm, plant, other, out=out).go(
            resume=resume, progress=progress
        )


class Killed(BaseException):
    """Stands for a kill: nothing after it runs."""


@pytest.mark.parametrize("name", SETTINGS)
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(scenario, name, tmp_path):
    run, algorithm = make_run(scenario, name)
    whole = train(run, algorithm)

    def die(done, row):
        if done == 350:
            raise Killed

    with pytest.raises(Killed):
        train(run, algorithm, tmp_path, progress=die)
    resumed = train(run, algorithm, tmp_path, resume=True)
    assert np.array_equal(resumed.parameters.theta, whole.parameters.theta)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert resumed.evaluation == whole.evaluation
    assert not np.array_equal(whole.parameters.theta, train_start(run))


def train_start(run):
    from controllers.problem import Problem
    from learning.starting_point import starting_parameters

    return starting_parameters(Problem.from_scenario(run.scenario), run.configuration).theta


def test_another_runs_checkpoint_is_refused(scenario, tmp_path):
    run, algorithm = make_run(scenario, "q-learning", samples=100)
    train(run, algorithm, tmp_path)
    other, _ = make_run(scenario, "q-learning", samples=100, seed=4)
    with pytest.raises(CheckpointError, match="seed is 3 there and 4 here"):
        train(other, algorithm, tmp_path, resume=True)


def test_the_log_has_a_row_each_interval_and_the_greedy_figures_each_evaluation(scenario):
    run, algorithm = make_run(scenario, "q-learning")
    result = train(run, algorithm)
    assert [row["samples"] for row in result.rows] == list(range(50, 451, 50))
    evaluated = [row["samples"] for row in result.rows if not np.isnan(row["greedy_J"])]
    assert evaluated == [100, 200, 300, 400, 450]
    assert result.rows[-1]["greedy_J"] == pytest.approx(result.evaluation["J"])
    assert all(row["smallest_eigenvalue"] >= 1e-3 for row in result.rows)


def test_the_log_keeps_the_least_certificate_of_all_updates(scenario):
    run, algorithm = make_run(scenario, "q-learning")
    seen = []

    class Watched(algorithm):
        def observe(self, sample):
            update = super().observe(sample)
            if update is not None:
                seen.append((sample.number, update.smallest_eigenvalue))
            return update

    for row in train(run, Watched).rows:
        part = [v for number, v in seen if row["samples"] - 50 <= number < row["samples"]]
        if part:
            assert row["smallest_eigenvalue"] == min(part)


def test_divergence_stops_early_and_keeps_the_last_good_theta(scenario, tmp_path):
    run, algorithm = make_run(scenario, "actor-critic", divergence=1e-3)
    result = train(run, algorithm, tmp_path)
    assert result.status.startswith("diverged: greedy J")
    assert "at sample 100" in result.status
    assert len(result.rows) == 2
    assert np.array_equal(result.parameters.theta, train_start(run))


def test_a_step_that_is_not_finite_stops_the_run(scenario, monkeypatch):
    run, algorithm = make_run(scenario, "q-learning")

    class Broken(algorithm):
        def _recursive(self, number, td_error, gradient):
            return super()._recursive(number, float("nan") if number > 200 else td_error, gradient)

    result = train(run, Broken)
    assert result.status.startswith("diverged: TD errors or gradients are not finite")
    assert np.isfinite(result.parameters.theta).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "samples must be at least 1"),
        ({"evaluate_every": 70}, "multiple of log_every"),
    ],
)
def test_counts_that_make_no_run_are_refused(scenario, change, message):
    with pytest.raises(ConfigurationError, match=message):
        make_run(scenario, "q-learning", **change)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_kill_minus_nine_at_any_moment_then_resume_gives_the_same_files(name, tmp_path):
    def command(out, *more):
        settings = [f"--set={key}={value}" for key, value in SETTINGS[name].items()]
        counts = ["--log-every=50", "--evaluate-every=500", "--checkpoint-every=250"]
        return [
            sys.executable, "-m", "cosim", "train", "-a", name, "-n", "4000", "--out", str(out),
            "--json", *settings, *counts, *more,
        ]  # fmt: skip

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(command(whole), check=True, capture_output=True)
    rng = np.random.default_rng(1)
    process = subprocess.Popen(
        command(killed), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    for _ in range(3):
        deadline = time.monotonic() + 120
        seen = (
            (killed / "checkpoint.npz").stat().st_mtime_ns
            if (killed / "checkpoint.npz").exists()
            else 0
        )
        while process.poll() is None and time.monotonic() < deadline:
            path = killed / "checkpoint.npz"
            if path.exists() and path.stat().st_mtime_ns != seen:
                break
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.3))
        process.kill()
        process.wait()
        process = subprocess.Popen(
            command(killed, "--resume"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
    assert process.wait() == 0
    for file in ("learning.csv", "parameters.toml"):
        assert (whole / file).read_bytes() == (killed / file).read_bytes()
