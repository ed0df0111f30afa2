from types import SimpleNamespace

import numpy as np
import pytest

from learning import ActorCritic, BatchQLearning, QLearning
from learning.algorithm import load_algorithm
from learning.back_off import BackOff
from learning.configuration import Configuration
from learning.dyna import Dyna
from learning.errors import ConfigurationError
from learning.exploration import Strategy
from learning.model_based import ModelBased

CLASSES = (QLearning, BatchQLearning, ActorCritic, ModelBased, BackOff, Dyna)


@pytest.mark.parametrize("cls", CLASSES)
def test_every_hyperparameter_is_documented_and_has_a_default(cls):
    for hyperparameter in cls.Configuration.documentation():
        assert hyperparameter.meaning and hyperparameter.allowed, hyperparameter.name
        assert "Undefined" not in hyperparameter.default, hyperparameter.name


def test_what_a_hyperparameter_may_be_is_said_in_words():
    documented = {entry.name: entry.allowed for entry in Dyna.Configuration.documentation()}
    assert documented["rule"] == "kalman, td, fit"
    assert documented["prior_width"] == "number > 0"
    assert documented["discount"] == "number > 0, ≤ 1 or unset"
    assert documented["change_windows"] == "4 × integer ≥ 1"


def test_assignments_are_read_as_toml_and_bare_words_as_text():
    found = QLearning.Configuration.from_assignments(
        ["rule=fit", "step_size=1e-3", "scaled=false", "exploration_deviation=[3.0, 4.0]"]
    )
    assert (found.rule, found.step_size, found.scaled) == ("fit", 1e-3, False)
    assert found.exploration_deviation == (3.0, 4.0)


@pytest.mark.parametrize(
    ("algorithm", "assignment", "message"),
    [
        ("q-learning", "prior_width", "--set prior_width: write NAME=VALUE"),
        ("q-learning", "prior_widht=0.1", "did you mean 'prior_width'"),
        ("q-learning", "prior_width=nan", "prior_width"),
        ("q-learning", "rule=newton", "rule.*td"),
        ("q-learning", "step_every=many", "step_every"),
        ("q-learning", "step_size=0.1", "step_size: has no part in the rule kalman"),
        ("batch-q-learning", "parameter_drift=0.1", "parameter_drift: unknown field"),
        ("backoff", "exploration_share=0.1", "exploration_share: has no part in a rule that tries"),
    ],
)
def test_a_bad_assignment_and_one_that_acts_nowhere_are_refused(algorithm, assignment, message):
    with pytest.raises(ConfigurationError, match=message):
        load_algorithm(algorithm).Configuration.from_assignments([assignment])


LOWER, UPPER = np.array([100.0, 100.0]), np.array([400.0, 400.0])
POLICY = np.array([190.0, 215.0])


def make(kind, probability=1.0, deviation=(10.0,)):
    settings = {"exploration_probability": probability, "exploration_deviation": deviation}
    bounds = SimpleNamespace(action_lower=LOWER, action_upper=UPPER)
    return Strategy(Configuration(exploration=kind, **settings), bounds)


def draws(explore, rng, action=POLICY, count=20_000):
    return np.array([np.clip(explore(action, rng), LOWER, UPPER) for _ in range(count)])


def test_additive_noise_has_the_moments_asked_for(rng):
    actions = draws(make("additive", deviation=(10.0, 3.0)), rng)
    assert actions.mean(axis=0) == pytest.approx(POLICY, abs=0.3)
    assert actions.std(axis=0) == pytest.approx([10.0, 3.0], rel=0.03)


@pytest.mark.parametrize("action", [POLICY, np.array([100.0, 395.0]), np.array([104.0, 400.0])])
def test_bias_is_the_mean_that_saturation_leaves(rng, action):
    explore = make("additive")
    measured = (draws(explore, rng, action, 60_000) - action).mean(axis=0)
    assert explore.bias(action[None])[0] == pytest.approx(measured, abs=0.15)


def test_bias_is_of_actions_about_zero_too(rng):
    explore = make("literal", deviation=(150.0,))
    measured = (draws(explore, rng) - POLICY).mean(axis=0)
    assert explore.bias(POLICY[None])[0] == pytest.approx(measured, abs=2.0)


def test_noise_is_drawn_alike_whatever_the_probability():
    paired = []
    for probability in (0.0, 1.0):
        rng = np.random.default_rng(3)
        explore = make("additive", probability)
        for _ in range(10):
            explore(POLICY, rng)
        paired.append(rng.random())
    assert paired[0] == paired[1]
