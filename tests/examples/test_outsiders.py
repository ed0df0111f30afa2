"""Outsiders in the benchmark's table, as their stored weights and θ."""

from pathlib import Path

import numpy as np
import pytest

from cosim import Scenario, evaluate
from examples.outsiders import policy

FOLDER = Path(__file__).parents[2] / "examples" / "outsiders"


@pytest.fixture
def paper():
    return Scenario.load("paper")


def weights(path, W, last="none"):
    np.savez(path, layers=1, between="tanh", last=last, W0=W, b0=np.zeros(2))
    return path


def test_a_network_that_gives_nothing_holds_the_middle_of_the_box(paper, tmp_path):
    agent = policy.NeuralPolicy(paper, weights(tmp_path / "zero.npz", np.zeros((2, 2))))
    np.testing.assert_allclose(agent.feedback(np.array([30.0, 60.0])).action, [250.0, 250.0])


def test_actions_stay_in_the_box(paper, tmp_path):
    agent = policy.NeuralPolicy(paper, weights(tmp_path / "large.npz", 1e3 * np.eye(2)))
    np.testing.assert_allclose(agent.feedback(np.array([30.0, 40.0])).action, [400.0, 100.0])


def test_other_weights_have_another_hash(paper, tmp_path):
    a, b = (
        policy.NeuralPolicy(paper, weights(tmp_path / f"{k}.npz", k * np.eye(2))) for k in (1, 2)
    )
    assert a.parameters.hash != b.parameters.hash


@pytest.mark.parametrize("name", ["sac", "ppo"])
def test_stored_policies_run_in_the_benchmark(paper, name):
    evaluation = evaluate(paper, {name: getattr(policy, name)}, 2, 100)
    assert np.isfinite(evaluation.column(name, "J")).all()
    assert (evaluation.column(name, "failures") == 0).all()
