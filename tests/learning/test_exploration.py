import numpy as np
import pytest

from learning.exploration import Strategy

LOWER, UPPER = np.array([100.0, 100.0]), np.array([400.0, 400.0])
POLICY = np.array([190.0, 215.0])


def make(kind, probability=1.0, deviation=(10.0,)):
    return Strategy(kind, LOWER, UPPER, probability, np.array(deviation))


def draws(explore, rng, action=POLICY, count=20_000):
    return np.array([np.clip(explore(action, rng), LOWER, UPPER) for _ in range(count)])


def test_additive_noise_has_the_moments_asked_for(rng):
    actions = draws(make("additive", deviation=(10.0, 3.0)), rng)
    assert actions.mean(axis=0) == pytest.approx(POLICY, abs=0.3)
    assert actions.std(axis=0) == pytest.approx([10.0, 3.0], rel=0.03)


def test_literal_reading_always_ends_in_the_lower_corner(rng):
    assert (draws(make("literal"), rng, count=100) == LOWER).all()


@pytest.mark.parametrize("action", [POLICY, np.array([100.0, 395.0]), np.array([104.0, 400.0])])
def test_bias_is_the_mean_that_saturation_leaves(rng, action):
    explore = make("additive")
    measured = (draws(explore, rng, action, 60_000) - action).mean(axis=0)
    assert explore.bias(action[None])[0] == pytest.approx(measured, abs=0.15)


def test_noise_is_drawn_alike_whatever_the_probability():
    paired = []
    for probability in (0.0, 1.0):
        rng = np.random.default_rng(3)
        explore = make("additive", probability)
        for _ in range(10):
            explore(POLICY, rng)
        paired.append(rng.random())
    assert paired[0] == paired[1]
