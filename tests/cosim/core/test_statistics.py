import numpy as np
import pytest
from scipy.stats import bootstrap, trim_mean, wilcoxon

from cosim.core import statistics
from cosim.core.statistics import (
    bootstrapped,
    gain,
    gap_closed,
    interquartile_mean,
    mean,
    over_runs,
    paired_difference,
    ratio,
    regret,
    shown,
    td_error_mean,
    two_way,
)


def test_t_interval_of_a_textbook_sample():
    # Student (1908), Cushny and Peebles' hours of sleep gained: 0.75 ± 1.28 at 9 degrees.
    hours = np.array([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0])
    estimate = mean(hours)
    assert estimate.value == pytest.approx(0.75)
    assert estimate.interval == pytest.approx((-0.5297804, 2.0297804), abs=1e-6)


@pytest.mark.parametrize(
    "method",
    [lambda a, b: ratio(a, b).interval, bootstrapped, lambda a, b: mean(a - b + 3.5).interval],
)
def test_intervals_of_a_ratio_and_a_mean_cover_the_truth_at_their_level(method):
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(100):
        common = rng.normal(0.0, 1.0, 25)
        numerator = 3.0 + common + rng.normal(0.0, 0.3, 25)
        denominator = 6.0 + common + rng.normal(0.0, 0.3, 25)
        low, high = method(numerator, denominator)
        covered += low <= 0.5 <= high
    assert 88 <= covered <= 100


def test_the_bootstrap_of_rare_spikes_does_not_fall_below_what_was_seen():
    cost, optimum = np.array([101.0] * 9 + [400.0]), np.full(10, 100.0)
    low = bootstrapped(cost - optimum, optimum)[0]
    assert low >= 0.01 and ratio(cost - optimum, optimum).interval[0] < 0.0
    assert bootstrapped(optimum, optimum) == (1.0, 1.0)


def test_what_is_not_defined_is_none_or_nan():
    assert mean(np.array([3.0])) == (3.0, None)
    assert np.isnan(ratio(np.ones(3), np.zeros(3)).value)
    estimate = mean(np.array([1.0, np.nan, 2.0]))
    assert np.isnan(estimate.value) and estimate.interval is None


def test_regret_gap_and_gain_are_ratios_of_means():
    naive, tuned, optimum = np.array([110.0, 90.0]), np.array([85.0, 75.0]), np.array([60.0, 40.0])
    assert regret(tuned, optimum).value == pytest.approx(30 / 50)
    assert gain(tuned, naive).value == pytest.approx(20 / 100)
    assert gap_closed(tuned, naive, optimum).value == pytest.approx(20 / 50)


def test_a_worse_controller_shows_a_loss_where_the_cost_is_a_profit():
    # The CSTR's J is negative: naive −5.929, a learner −5.699, which is dearer by 3.87 %.
    naive, learner = np.full(3, -5.929), np.full(3, -5.699)
    assert gain(learner, naive).value == pytest.approx(-0.0388, abs=1e-4)
    assert regret(learner, naive).value == pytest.approx(0.0388, abs=1e-4)


@pytest.mark.parametrize(
    ("value", "ends", "digits", "text"),
    [
        (-5.929, None, 4, "-5.929"),
        (-5.938, (-6.0, -5.9), 4, "-5.938 [-6.000, -5.900]"),
        (28643.5, (27000.0, 30000.0), 5, "28644 [27000, 30000]"),
        (0.0341234, (0.0331, 0.0351), 3, "0.0341 [0.0331, 0.0351]"),
        (6347.6, (6347.58, 6347.62), 5, "6347.600 [6347.580, 6347.620]"),
        (0.0, (0.0, 0.0), 3, "0 [0, 0]"),
        (float("nan"), None, 3, "nan"),
    ],
)
def test_figures_show_significant_digits(value, ends, digits, text):
    assert shown(value, ends, digits=digits) == text


def test_the_td_mean_is_that_of_the_updates_within_the_window():
    rng = np.random.default_rng(0)
    samples = np.arange(1, 41) * 500.0
    updates = rng.integers(0, 6, 40).astype(float)
    errors = np.where(updates > 0, rng.normal(size=40), np.nan)
    found = td_error_mean(samples, errors, updates, 10_000)
    for k in range(40):
        inside = (samples > samples[k] - 10_000) & (samples <= samples[k])
        each = np.repeat(errors[inside], updates[inside].astype(int))
        assert found[k] == pytest.approx(np.sqrt(np.mean(each**2)), rel=1e-12)


@pytest.mark.parametrize("runs", [4, 8, 12])
def test_the_interquartile_mean_is_the_mean_of_the_middle_half(runs):
    values = np.random.default_rng(runs).normal(size=(3, runs))
    assert interquartile_mean(values) == pytest.approx(trim_mean(values, 0.25, axis=-1))


def test_the_interquartile_mean_counts_shares_of_runs():
    assert interquartile_mean(np.array([5.0])) == 5.0
    # Of five runs 1.25 are cut on either side: a quarter of the second and of the fourth.
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 4.0, 99.0])) == pytest.approx(
        (0.75 * 1 + 2 + 0.75 * 4) / 2.5
    )


def test_the_bootstrap_over_runs_stays_within_its_strata():
    """Strata without spread leave nothing to resample, however far apart they are."""
    strata = [np.full(5, 1.0), np.full(5, 100.0)]
    assert over_runs(strata).interval == pytest.approx((over_runs(strata).value,) * 2)
    spread = np.random.default_rng(1).normal(size=20)
    low, high = over_runs([spread]).interval
    assert low < over_runs([spread]).value < high
    assert (low, high) == over_runs([spread]).interval


def test_the_interval_of_equal_runs_is_their_very_value():
    for value in np.random.default_rng(3).normal(size=20):
        assert over_runs([np.full(4, value)]).interval == (value, value)


def test_rounding_about_zero_is_shown_as_zero():
    assert shown(3e-17, (0.0, 5e-17), scale=100.0, digits=3) == "0 [0, 0]"


def test_a_diverged_counterpart_is_the_worst_one_not_the_case():
    cost = np.full((7, 4), 9.0)
    other = np.full((7, 4), 10.0)
    other[-1] = np.inf
    median, interval, _ = paired_difference(cost, other, np.full(4, 10.0))
    assert median == pytest.approx(-0.1)
    assert interval[1] == pytest.approx(-0.1)


def test_a_diverged_run_is_the_worst_and_spoils_no_interval():
    cost = 100.0 + np.arange(1.0, 8.0)[:, None] + np.zeros((7, 4))
    cost[-1] = np.nan
    low, high = two_way(cost, np.full(4, 100.0))
    assert 0.01 <= low < high <= 0.06 + 1e-12


@pytest.mark.parametrize("count", [5, 10])
def test_p_of_paired_differences_is_that_of_the_exact_signed_rank_test(count):
    rng = np.random.default_rng(count)
    optimum, other = np.full(6, 10.0), rng.random((count, 6)) + 11.0
    cost = other + rng.normal(0.2, 0.3, (count, 1))
    difference, (low, high), p = paired_difference(cost, other, optimum)
    each = (cost - other).mean(axis=1)
    assert difference == pytest.approx(np.median(each) / 10.0)
    assert low <= difference <= high
    assert p == pytest.approx(wilcoxon(each, method="exact").pvalue, abs=1e-12)


SHAPES = [
    (10, 50, 0.5, 0.5),
    pytest.param(5, 50, 0.5, 0.5, marks=pytest.mark.slow),
    pytest.param(10, 20, 0.5, 0.5, marks=pytest.mark.slow),
    pytest.param(10, 50, 0.05, 0.5, marks=pytest.mark.slow),
    pytest.param(10, 50, 1.0, 0.1, marks=pytest.mark.slow),
]
"""Training seeds, noise seeds, and the spread that each brings about in J."""


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "seeds", "by_run", "by_noise"), SHAPES)
def test_the_two_way_interval_covers_the_median_at_its_level(
    runs, seeds, by_run, by_noise, monkeypatch
):
    """Random effects of run, noise seed and both; 1000 studies, with fewer resamples for speed."""
    monkeypatch.setattr(statistics, "RESAMPLES", 299)
    rng, covered = np.random.default_rng(7), 0
    for _ in range(1000):
        optimum = 100.0 + rng.normal(size=seeds)
        effects = rng.normal(0.0, by_run, (runs, 1)) + rng.normal(0.0, by_noise, seeds)
        cost = optimum + 2.0 + effects + rng.normal(0.0, by_noise, (runs, seeds))
        low, high = two_way(cost, optimum)
        covered += low <= 0.02 <= high
    assert 0.92 < covered / 1000 < 0.98


@pytest.mark.slow
@pytest.mark.parametrize("runs", [5, 10])
def test_p_is_uniform_where_nothing_differs(runs, monkeypatch):
    """At each value that p can take, so small a p is as likely as p says."""
    monkeypatch.setattr(statistics, "RESAMPLES", 2)  # the interval is not asked for
    rng, optimum, found = np.random.default_rng(runs), np.full(6, 100.0), []
    for _ in range(2000):
        cost = optimum + rng.normal(size=(2, runs, 1)) + rng.normal(size=(2, runs, 6))
        found.append(paired_difference(*cost, optimum)[2])
    for p in np.unique(found):
        spread = np.sqrt(p * (1 - p) / 2000)
        assert np.mean(np.array(found) <= p) == pytest.approx(p, abs=4.5 * spread + 1e-3)


def test_the_median_over_runs_has_the_interval_of_runs_drawn_anew(rng):
    values = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    estimate = statistics.median_over_runs(values)
    assert estimate.value == 4.0
    drawn = np.median(rng.choice(values, size=(100_000, 5)), axis=1)
    assert estimate.interval == tuple(np.quantile(drawn, [0.025, 0.975], method="nearest"))


def test_one_run_has_no_interval_and_a_diverged_one_an_infinite_end():
    assert statistics.median_over_runs(np.array([3.0])) == (3.0, None)
    assert statistics.median_over_runs(np.array([3.0, np.inf, 3.0])) == (3.0, (3.0, np.inf))


def test_the_bootstraps_are_those_of_scipy():
    rng = np.random.default_rng(4)
    below = rng.uniform(5.0, 6.0, 12)
    above = rng.lognormal(0.0, 1.0, 12)
    settings = {"n_resamples": 9999, "vectorized": True}

    def quotient(a, b, axis):
        return a.mean(axis) / b.mean(axis)

    expected = bootstrap((above, below), quotient, paired=True, rng=0, **settings)
    assert bootstrapped(above, below) == pytest.approx(expected.confidence_interval, rel=1e-12)

    strata = [rng.lognormal(0.0, 1.0, count) for count in (3, 5)]

    def middle(*runs, axis):
        return interquartile_mean(np.concatenate(runs, axis), axis)

    expected = bootstrap(strata, middle, method="percentile", rng=0, **settings)
    assert over_runs(strata).interval == pytest.approx(expected.confidence_interval, rel=1e-12)
