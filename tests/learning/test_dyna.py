"""`dyna`: the plant that the empirical model plays, and the rule on both."""

from __future__ import annotations

import numpy as np
import pytest

from controllers.problem import Problem
from learning.dyna import ModelPlant
from learning.empirical_model import Features
from learning.log import to_csv
from learning.training import run_training
from tests.helpers.empirical import fit
from tests.helpers.training import killed_and_resumed, make_run


def test_the_model_plays_the_plant_that_it_was_fitted_to(scenario, rng):
    features = Features(Problem.from_scenario(scenario))
    inputs = rng.normal([27.0, 60.0, 220.0, 230.0], [2.0, 6.0, 20.0, 20.0], (500, 4))
    y, _, h = features(inputs, np.zeros(features.n_parameters))
    noise = rng.uniform(-0.1, 0.1, y.shape)
    model = fit(features, inputs, 1.02 * y + h * noise)
    plant = ModelPlant(scenario, model, np.array([24.0, 60.0]), rng)
    a, states, errors = np.array([220.0, 230.0]), [np.array([24.0, 60.0])], []
    for _ in range(400):
        step = plant.step(a)
        predicted, h, _ = model.predict(np.concatenate([states[-1], a])[None])
        outcome = np.append(step.s, step.stage_cost)
        errors.append((outcome - predicted[0]) / h[0])
        assert step.penalty == scenario.state_penalty(states[-1].tolist())
        states.append(step.s)
    distances = np.abs(np.array(errors)[:, None] - model.residuals).max(axis=2)
    assert distances.min(axis=1).max() < 1e-9
    assert len(np.unique(distances.argmin(axis=1))) > 200


@pytest.mark.slow
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(scenario, tmp_path):
    settings = {"interval": 20, "prior_samples": 30, "step_every": 10, "exploration_samples": 25}
    every = {"samples": 60, "log_every": 20, "evaluate_every": 60, "checkpoint_every": 20}
    run = make_run("learning.dyna:Dyna", scenario, settings, start="tuned", **every)
    whole = run_training(run)
    assert whole.requires == "operation"
    assert not np.array_equal(whole.parameters.theta, run.starting_parameters().theta)
    resumed = killed_and_resumed(run, tmp_path, 40)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert np.array_equal(resumed.parameters.theta, whole.parameters.theta)
