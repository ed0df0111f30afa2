"""Exploration: how often it takes place."""

import numpy as np
import pytest

from learning import ActorCritic, QLearning
from learning.exploration import Strategy


def explored(configuration, scenario, samples):
    """Which of the first samples explore, (K,) of bool."""
    strategy = Strategy(configuration, scenario)
    rng = np.random.default_rng(5)
    action = scenario.reference_action
    return np.array([strategy(action, rng, k) is not None for k in range(samples)])


def test_the_share_that_explores_falls_in_inverse_proportion_to_the_samples(scenario):
    settings = {"exploration_probability": 0.5}
    schedule = QLearning.Configuration(exploration_decay_after=2000, **settings)
    falling = explored(schedule, scenario, 40_000)
    full = explored(
        QLearning.Configuration(exploration_decay_after=None, **settings), scenario, 40_000
    )
    # The first samples are the same ones, and later ones are among those of full exploration.
    assert falling[:2000].tolist() == full[:2000].tolist()
    assert full[falling].all()
    assert full.mean() == pytest.approx(0.5, abs=0.01)
    # Σ T/k from 20 000 to 40 000 is T ln 2.
    assert falling[20_000:].sum() == pytest.approx(0.5 * 2000 * np.log(2), rel=0.1)


def test_a_scenario_that_states_its_exploration_is_explored_to_the_end(scenario):
    table = {"kind": "additive", "probability": 0.3, "standard_deviation": [3.0, 3.0]}
    stated = scenario.replace({"exploration": table})
    configuration = QLearning.Configuration().for_scenario(stated)
    assert configuration.exploration_decay_after is None
    assert explored(configuration, stated, 9000)[6000:].mean() == pytest.approx(0.3, abs=0.03)


def test_rules_that_learn_from_exploration_alone_explore_to_the_end():
    assert ActorCritic.Configuration().full_exploration == np.inf
    assert QLearning.Configuration(rule="fit").full_exploration == np.inf
    assert QLearning.Configuration().full_exploration == 1440
