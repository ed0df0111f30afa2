import dataclasses

import numpy as np
import pytest

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim import FmuPlant
from learning.algorithm import Update
from learning.log import to_csv
from learning.q_learning import QLearning
from learning.training import run_training
from tests.helpers import training
from tests.helpers.training import killed_and_resumed

SETTINGS = {
    "q-learning": {"prior_samples": 20, "step_every": 20},
    "batch-q-learning": {"batch_size": 50},
    "actor-critic": {"batch_size": 80},
}


def make_run(scenario, name, **changes):
    values = {"samples": 450, "seed": 3, "evaluation_steps": 20}
    every = {"log_every": 50, "evaluate_every": 100, "checkpoint_every": 100}
    return training.make_run(name, scenario, SETTINGS[name], **{**values, **every, **changes})


@pytest.mark.parametrize("name", SETTINGS)
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(scenario, name, tmp_path):
    run = make_run(scenario, name, samples=250)
    whole = run_training(run)
    resumed = killed_and_resumed(run, tmp_path, 150)
    assert np.array_equal(resumed.parameters.theta, whole.parameters.theta)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert resumed.evaluation == whole.evaluation
    assert not np.array_equal(whole.parameters.theta, whole.start.theta)


def test_the_log_has_a_row_each_interval_and_the_greedy_figures_each_evaluation(scenario):
    run = make_run(scenario, "q-learning")
    result = run_training(run)
    assert [row["samples"] for row in result.rows] == list(range(0, 451, 50))
    evaluated = [row["samples"] for row in result.rows if not np.isnan(row["greedy_J"])]
    assert evaluated == [0, 100, 200, 300, 400, 450]
    assert result.rows[0]["greedy_J"] == result.start_J
    assert np.array_equal(result.rows[0].parameters.theta, result.start.theta)
    assert result.updates == sum(row["updates"] for row in result.rows) > 3
    assert result.rows[-1]["greedy_J"] == pytest.approx(result.evaluation["J"])
    assert all(row["smallest_eigenvalue"] >= 1e-3 for row in result.rows)


@pytest.mark.parametrize("seeds", [0, 2])
def test_the_held_out_samples_are_those_that_the_plant_took(scenario, seeds, monkeypatch):
    taken = []
    step = FmuPlant.step

    def counted(plant, action):
        taken.append(plant)
        return step(plant, action)

    monkeypatch.setattr(FmuPlant, "step", counted)
    run = make_run(scenario, "q-learning", evaluation_seeds=seeds)
    summary = run_training(run).summary()
    assert summary["plant_samples"] + summary["held_out_samples"] == len(taken)
    assert bool(summary["held_out_samples"]) == bool(seeds)


def test_without_held_out_runs_no_verdict_is_made_up(scenario, tmp_path):
    run = make_run(scenario, "q-learning", evaluation_seeds=0)
    result = run_training(run)
    assert (result.status, result.verdict) == ("finished", "not compared: no held-out runs")
    assert np.array_equal(result.parameters.theta, result.learned.theta)
    assert np.isnan([result.J, result.start_J, result.regret, result.difference.value]).all()
    assert np.isnan(result.log()["greedy_J"]).all()
    # With the picture.
    result.save(tmp_path)
    judged = run_training(make_run(scenario, "q-learning"))
    assert np.array_equal(judged.learned.theta, result.learned.theta)


def test_a_diverged_run_ends_with_its_own_theta(scenario, tmp_path):
    run = make_run(scenario, "actor-critic")
    # Less than a user may give: by it each policy has diverged.
    object.__setattr__(run, "divergence", 1e-3)
    result = run_training(run, tmp_path)
    assert result.status.startswith("diverged: greedy J")
    assert "at sample 200" in result.status, "the second evaluation in a row"
    last = result.rows[-1]
    assert last["samples"] == 200
    own = last.parameters.theta.tolist()
    assert result.parameters.theta.tolist() == own
    assert not np.array_equal(result.parameters.theta, result.start.theta)
    assert result.evaluation["J"] == last["greedy_J"]


def test_a_step_that_is_not_finite_stops_the_run(scenario):
    run = make_run(scenario, "q-learning")

    class Broken(QLearning):
        def observe(self, sample):
            cost = float("nan") if sample.number > 200 else sample.cost
            return super().observe(sample._replace(cost=cost))

    result = run_training(run, rule=Broken)
    assert result.status.startswith("diverged: the step of θ is not finite")
    assert result.rows[-1]["samples"] == 220, "the row of the sample at which it broke"
    assert result.rows[-1]["greedy_J"] == result.evaluation["J"]
    assert not np.array_equal(result.parameters.theta, result.start.theta)


class Spoiling(QLearning):
    """Moves θ once to where each cost is higher."""

    def observe(self, sample):
        if sample.number != 40:
            return None
        parameters = self.controller.parameters
        self.controller.parameters = parameters.replace({"x_l": parameters["x_l"] - 10.0})
        return Update(td_error=0.0, step=1.0, smallest_eigenvalue=1.0)


def test_where_theta_is_worse_than_the_start_the_start_is_kept(scenario, tmp_path):
    settings = {"samples": 100, "start": "tuned", "evaluation_seeds": 3}
    result = run_training(make_run(scenario, "q-learning", **settings), tmp_path, rule=Spoiling)
    assert result.verdict == "worse: the start was kept"
    assert result.difference.interval[0] > 0
    assert result.difference.value == pytest.approx(result.J - result.start_J)
    assert np.array_equal(result.parameters.theta, result.start.theta)
    assert not np.array_equal(result.learned.theta, result.start.theta)
    stored = Parameters.load(tmp_path / "parameters.toml", Problem.from_scenario(scenario))
    assert np.array_equal(stored.theta, result.start.theta)


def test_a_theta_that_stays_is_told_with_the_reason(scenario):
    run = training.make_run("fixed", scenario, start="tuned", evaluation_seeds=3)
    result = run_training(run)
    assert (result.verdict, result.difference.value) == ("θ was not changed", 0.0)
    assert result.updates == 0
    assert "the rule made no update" in result.summary()["reason"]
    diverged = dataclasses.replace(result, status="diverged: at once")
    assert diverged.reason == "the run ended before θ moved"


class Predicting(QLearning):
    """Moves θ once, and knows what it will cost and that the plant has changed."""

    predicted_cost = 6543.0
    changes = 2

    def observe(self, sample):
        if sample.number != 60:
            return None
        return Update(td_error=0.0, step=0.0, smallest_eigenvalue=1.0)


def test_the_summary_sets_the_predicted_cost_beside_the_realised_one(scenario):
    run = make_run(scenario, "q-learning", samples=180)
    result = run_training(run, rule=Predicting)
    summary = result.summary()
    assert (summary["predicted_cost"], summary["changes"]) == (6543.0, 2)
    # The update is in the second row of 50 samples; a third and 30 samples come after it.
    after = [row for row in result.rows if row["samples"] > 100]
    realised = (50 * after[0]["J"] + 30 * after[1]["J"]) / 80
    assert summary["realised_cost"] == pytest.approx(realised)
    assert (summary["updates"], summary["retreats"]) == (1, 0)


class Trying(QLearning):
    """Hands over its start while the controller carries a candidate without any back-off."""

    def __init__(self, controller, *rest):
        super().__init__(controller, *rest)
        self._carrier, self.theta = controller, controller.theta.copy()

    def observe(self, sample):
        parameters = self._carrier.parameters
        self._carrier.parameters = parameters.replace({"x_l": [10.0, 20.0]})
        return Update(td_error=0.0, step=1.0, smallest_eigenvalue=1.0)


def test_all_is_of_the_theta_that_is_handed_over_not_of_a_candidate(scenario, tmp_path):
    run = make_run(scenario, "q-learning", samples=200, divergence=1.01)
    result = run_training(run, tmp_path, rule=Trying)
    assert result.status == "finished" and result.rows[-1]["J"] > 2 * result.J
    assert result.J == result.start_J == result.rows[-1]["greedy_J"]
    for row in result.rows:
        assert np.array_equal(row.parameters.theta, result.start.theta)
    stored = Parameters.load(tmp_path / "parameters.toml", Problem.from_scenario(scenario))
    assert np.array_equal(stored.theta, result.start.theta)
