import numpy as np
import pytest

from learning.errors import ConfigurationError
from learning.exploration import strategy
from learning.schedule import linear

LOWER, UPPER = np.array([100.0, 100.0]), np.array([400.0, 400.0])
POLICY = np.array([190.0, 215.0])
FIRST = np.array([0])


def make(kind, probability=1.0, deviation=(10.0,)):
    return strategy(
        kind, LOWER, UPPER, linear(probability, None, 100), linear(deviation, None, 100)
    )


def draws(explore, rng, action=POLICY, count=20_000):
    perturbed = [explore(action, rng, 0, lambda d: action + d) for _ in range(count)]
    return np.array([np.clip(a, LOWER, UPPER) for a in perturbed])


def test_additive_noise_has_the_moments_asked_for(rng):
    actions = draws(make("additive", deviation=(10.0, 3.0)), rng)
    assert actions.mean(axis=0) == pytest.approx(POLICY, abs=0.3)
    assert actions.std(axis=0) == pytest.approx([10.0, 3.0], rel=0.03)


def test_a_greedy_sample_returns_nothing(rng):
    explore = make("additive", probability=0.3)
    greedy = [explore(POLICY, rng, 0, lambda d: d) is None for _ in range(5000)]
    assert np.mean(greedy) == pytest.approx(0.7, abs=0.03)


def test_literal_reading_always_ends_in_the_lower_corner(rng):
    assert (draws(make("literal"), rng, count=100) == LOWER).all()


def test_perturbed_cost_asks_the_policy_of_the_perturbed_cost(rng):
    seen = []

    def perturbed(d):
        seen.append(d)
        return POLICY + 1.0

    assert (make("perturbed-cost")(POLICY, rng, 0, perturbed) == POLICY + 1.0).all()
    assert len(seen) == 1 and seen[0].shape == (2,)


@pytest.mark.parametrize("action", [POLICY, np.array([100.0, 395.0]), np.array([104.0, 400.0])])
def test_bias_is_the_mean_that_saturation_leaves(rng, action):
    explore = make("additive")
    measured = (draws(explore, rng, action, 60_000) - action).mean(axis=0)
    assert explore.bias(action[None], FIRST)[0] == pytest.approx(measured, abs=0.15)


def test_bias_of_the_literal_reading_is_the_way_to_the_corner():
    assert make("literal").bias(POLICY[None], FIRST)[0] == pytest.approx(LOWER - POLICY, abs=1e-6)


def test_bias_of_the_perturbed_cost_is_not_known():
    assert np.isnan(make("perturbed-cost").bias(POLICY[None], FIRST)).all()


def test_noise_is_drawn_alike_whatever_the_probability():
    paired = []
    for probability in (0.0, 1.0):
        rng = np.random.default_rng(3)
        explore = make("additive", probability)
        for _ in range(10):
            explore(POLICY, rng, 0, lambda d: d)
        paired.append(rng.random())
    assert paired[0] == paired[1]


def test_a_wrong_number_of_deviations_is_refused():
    with pytest.raises(ConfigurationError, match="3 entries"):
        make("additive", deviation=(1.0, 2.0, 3.0))


def test_an_unknown_strategy_is_named():
    with pytest.raises(ConfigurationError, match=r"'random'.*additive, literal, perturbed-cost"):
        make("random")
