import numpy as np
import pytest

from cosim.evaluation.statistics import mean, ratio


def test_t_interval_of_a_textbook_sample():
    # Student (1908), Cushny and Peebles' hours of sleep gained: 0.75 ± 1.28 at 9 degrees.
    hours = np.array([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0])
    estimate = mean(hours)
    assert estimate.value == pytest.approx(0.75)
    assert estimate.t == pytest.approx((-0.5297804, 2.0297804), abs=1e-6)


@pytest.mark.parametrize("method", ["t", "bootstrap"])
def test_intervals_of_a_mean_cover_the_truth_at_their_level(method):
    rng = np.random.default_rng(1)
    intervals = [getattr(mean(rng.normal(2.0, 1.0, 20)), method) for _ in range(100)]
    covered = sum(low <= 2.0 <= high for low, high in intervals)
    assert 88 <= covered <= 100


@pytest.mark.parametrize("method", ["t", "bootstrap"])
def test_intervals_of_a_ratio_cover_the_truth_at_their_level(method):
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(100):
        common = rng.normal(0.0, 1.0, 25)
        numerator = 3.0 + common + rng.normal(0.0, 0.3, 25)
        denominator = 6.0 + common + rng.normal(0.0, 0.3, 25)
        low, high = getattr(ratio(numerator, denominator), method)
        covered += low <= 0.5 <= high
    assert 88 <= covered <= 100


def test_pairing_makes_a_ratio_of_proportional_columns_exact():
    base = np.array([10.0, 40.0, 20.0, 90.0])
    estimate = ratio(0.21 * base, base)
    assert estimate.value == pytest.approx(0.21)
    assert estimate.t == pytest.approx((0.21, 0.21), abs=1e-12)
    assert estimate.bootstrap == pytest.approx((0.21, 0.21), abs=1e-12)


def test_one_seed_has_no_interval():
    estimate = mean(np.array([3.0]))
    assert (estimate.value, estimate.t, estimate.bootstrap) == (3.0, None, None)


def test_equal_values_have_a_point_for_an_interval():
    assert mean(np.full(5, 7.0)).bootstrap == (7.0, 7.0)


def test_a_ratio_to_zero_is_undefined():
    assert np.isnan(ratio(np.ones(3), np.zeros(3)).value)


def test_the_bootstrap_repeats_its_bits():
    values = np.random.default_rng(3).normal(size=12)
    assert mean(values) == mean(values)


def test_a_value_that_is_not_finite_leaves_no_interval():
    estimate = mean(np.array([1.0, np.nan, 2.0]))
    assert np.isnan(estimate.value)
    assert (estimate.t, estimate.bootstrap) == (None, None)
