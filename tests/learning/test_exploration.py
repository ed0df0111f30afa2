import numpy as np
import pytest

from learning.exploration import Geometric, Strategy, linear

LOWER, UPPER = np.array([100.0, 100.0]), np.array([400.0, 400.0])
POLICY = np.array([190.0, 215.0])
FIRST = np.array([0])


def make(kind, probability=1.0, deviation=(10.0,)):
    return Strategy(
        kind, LOWER, UPPER, linear(probability, None, 100), linear(deviation, None, 100)
    )


def draws(explore, rng, action=POLICY, count=20_000):
    return np.array([np.clip(explore(action, rng, 0), LOWER, UPPER) for _ in range(count)])


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
    assert explore.bias(action[None], FIRST)[0] == pytest.approx(measured, abs=0.15)


def test_noise_is_drawn_alike_whatever_the_probability():
    paired = []
    for probability in (0.0, 1.0):
        rng = np.random.default_rng(3)
        explore = make("additive", probability)
        for _ in range(10):
            explore(POLICY, rng, 0)
        paired.append(rng.random())
    assert paired[0] == paired[1]


def test_a_linear_schedule_is_linear_and_then_constant():
    values = linear((10.0,), (2.0,), 100)
    assert values(0) == 10.0 and values(50) == 6.0 and values(100) == 2.0 and values(500) == 2.0


def test_values_at_many_samples_are_those_of_each():
    for end in (None, [9.0, -2.0]):
        for length in (0, 7):
            schedule = linear([1.0, 0.3], end, length)
            each = [schedule(k) for k in range(12)]
            assert schedule.at(np.arange(12)).tobytes() == np.array(each).tobytes()


def test_a_geometric_schedule_has_equal_ratios_and_then_stays():
    values = Geometric(0.5, 0.05, 100)
    found = [values(k) for k in range(0, 101, 10)]
    assert found[0] == 0.5 and found[-1] == pytest.approx(0.05, rel=1e-12)
    assert np.ptp(np.divide(found[1:], found[:-1])) < 1e-12
    assert values(500) == values(100)
