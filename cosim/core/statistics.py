"""The project's statistics: regret, gap closed, gain in J; means and intervals over seeds.

Every figure that a table, a log or a summary shows under one of these names comes from here. All
arrays are paired: entry s of each belongs to seed s. Intervals are of 95 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import floor, isfinite, log10, nan
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from cosim.core.protocols import Array

Interval = tuple[float, float] | None

LEVEL = 0.95
RESAMPLES = 9999
RESAMPLED = 10_000
"""Most seeds that are resampled; with more of them Student's interval is as good."""
AT_ONCE = RESAMPLES * 1000
"""Most values that are drawn at once."""
NEGLIGIBLE = 1e-12
"""Spread of values, relative to the larger of 1 and their mean, that is taken for none."""
EXHAUSTIVE_PAIRS = 12
"""Most pairs of runs for which all flips of signs are tried, 2¹² = 4096 of them."""
TD_WINDOW = 10_000
"""Samples over which a TD error is averaged (paper.tex, fig. nmpc_learn)."""


class Estimate(NamedTuple):
    """A value with its 95 % `interval` (low, high), None where nothing is known of its spread."""

    value: float
    interval: Interval = None


def mean(values: Array) -> Estimate:
    """Mean of S independent values (S,), with Student's interval; none for one value."""
    value = float(np.mean(values))
    return Estimate(value, _t_interval(values, value))


def ratio(numerator: Array, denominator: Array) -> Estimate:
    """Ratio of the means of S paired values.

    The interval is Student's of the linearised ratio (delta method): of (aₛ − r bₛ)/mean(b).

    Args:
        numerator: a, (S,).
        denominator: b, (S,).

    Returns:
        The ratio; NaN where the denominator's mean is zero.
    """
    below = float(np.mean(denominator))
    above = float(np.mean(numerator))
    if not below:
        return Estimate(nan)
    value = above / below
    # An infinite cost has no interval.
    with np.errstate(invalid="ignore"):
        errors = numerator - value * denominator
        linearised = errors / below
    interval = _t_interval(linearised, value)
    return Estimate(value, interval)


def bootstrapped(numerator: Array, denominator: Array) -> Interval:
    """BCa bootstrap interval of `ratio`, resampling seeds, for skewed costs.

    Args:
        numerator: (S,).
        denominator: (S,).

    Returns:
        None for one seed, for more than `RESAMPLED`, and where a value is not finite.
    """
    seeds = len(numerator)
    if not 2 <= seeds <= RESAMPLED:
        return None
    if not np.isfinite(numerator).all():
        return None
    above = np.sum(numerator)
    below = np.sum(denominator)
    if not below:
        return None
    value = float(above / below)
    # The ratio of all seeds but one, for each: BCa's acceleration is that of their differences.
    without_one = (above - numerator) / (below - denominator)
    # BCa is undefined where no seed counts.
    if _all_equal(without_one, value):
        return value, value

    def quotient(
        above: Array,
        below: Array,
        axis: int,
    ) -> Any:
        mean_above = np.mean(above, axis=axis)
        mean_below = np.mean(below, axis=axis)
        return mean_above / mean_below

    return _bootstrap((numerator, denominator), quotient, paired=True, method="BCa")


def _all_equal(values: Array, level: float) -> bool:
    """Whether values differ by rounding alone, at a mean of about `level`."""
    scale = max(1.0, abs(level))
    return bool(np.ptp(values) <= NEGLIGIBLE * scale)


def _bootstrap(data: Sequence[Array], statistic: Callable[..., Any], **options: Any) -> Interval:
    """Interval of a statistic of resampled data, with a fixed seed."""
    from scipy import stats  # noqa: PLC0415 - most of a second

    # SciPy draws a batch of resamples at once, and keeps it: a limit of the memory.
    longest = max(len(values) for values in data)
    batch = max(1, AT_ONCE // longest)
    result = stats.bootstrap(
        tuple(data),
        statistic,
        n_resamples=RESAMPLES,
        batch=batch,
        confidence_level=LEVEL,
        # The same table has the same interval, whoever makes it.
        rng=np.random.default_rng(0),
        **options,
    )
    low, high = result.confidence_interval
    # BCa has none where all resamples lie on one side of the value.
    if not (isfinite(low) and isfinite(high)):
        return None
    return float(low), float(high)


def regret(cost: Array, optimum: Array) -> Estimate:
    """(J − J*)/|J*|, as a ratio of means.

    Args:
        cost: J of each seed, (S,).
        optimum: J* of each seed, (S,).
    """
    return ratio(cost - optimum, magnitude(optimum))


def gain(cost: Array, reference: Array) -> Estimate:
    """Gain in J over a reference, (J_ref − J)/|J_ref|, as a ratio of means.

    Args:
        cost: J of each seed, (S,).
        reference: J_ref of each seed, (S,).
    """
    return ratio(reference - cost, magnitude(reference))


def gap_closed(
    cost: Array,
    naive: Array,
    optimum: Array,
) -> Estimate:
    """(J_naive − J)/(J_naive − J*), as a ratio of means.

    Args:
        cost: J of each seed, (S,).
        naive: J of the untrained start, (S,).
        optimum: J*, (S,).
    """
    return ratio(naive - cost, naive - optimum)


def regrets(cost: Array, optimum: Array | float) -> Array:
    """`regret` of each seed by itself, (S,).

    Args:
        cost: J of each seed, (S,).
        optimum: J*, (S,) or one for all.
    """
    return relative(cost - optimum, optimum)


def relative(difference: Array, optimum: Array | float) -> Array:
    """Differences of costs in the unit of a regret, (J − J')/|J*| of each seed by itself, (S,).

    Args:
        difference: J − J', (S,).
        optimum: J*, (S,) or one for all.
    """
    return _quotients(difference, np.abs(optimum))


def regret_terms(cost: Array, optimum: Array) -> Array:
    """Contribution of each seed or segment to `regret`, their mean, (S,).

    Args:
        cost: J, (S,).
        optimum: J*, (S,).
    """
    return (cost - optimum) / abs(np.mean(optimum))


def gains(cost: Array, reference: Array) -> Array:
    """`gain` of each seed by itself, (S,).

    Args:
        cost: J of each seed, (S,).
        reference: J_ref of each seed, (S,).
    """
    return _quotients(reference - cost, np.abs(reference))


def gaps_closed(
    cost: Array,
    naive: Array,
    optimum: Array,
) -> Array:
    """`gap_closed` of each seed by itself, (S,).

    Args:
        cost: J of each seed, (S,).
        naive: J of the untrained start, (S,).
        optimum: J*, (S,).
    """
    return _quotients(naive - cost, naive - optimum)


def _quotients(numerator: Array, denominator: Array | float) -> Array:
    """Quotients, NaN where the denominator is zero."""
    defined = denominator != 0
    # NumPy would warn of a division by zero, even where the quotient is not used.
    safe = np.where(defined, denominator, 1.0)
    quotients = numerator / safe
    return np.where(defined, quotients, np.nan)


def interquartile_mean(values: Array, axis: int = -1) -> Any:
    """Mean of the middle half of R values along an axis.

    Entries at a quarter of R count with their share. Source: Agarwal et al., Deep RL at the Edge of
    the Statistical Precipice.

    Args:
        values: (…, R, …).
        axis: that of the R values.

    Returns:
        The other axes, (…); a scalar for (R,).
    """
    runs_last = np.moveaxis(values, axis, -1)
    ordered = np.sort(runs_last)
    count = ordered.shape[-1]
    # Entry i has the interval [i, i+1] of ranks; its weight is what of that is in the middle half.
    ranks = np.arange(count + 1)
    edges = np.clip(ranks, 0.25 * count, 0.75 * count)
    weights = np.diff(edges)
    # Values outside may be infinite.
    inside = np.where(weights > 0, ordered, 0.0)
    weighted = inside * weights
    total = weighted.sum(axis=-1)
    return total / weights.sum()


def over_runs(strata: Sequence[Array]) -> Estimate:
    """Interquartile mean over training runs.

    The interval is a bootstrap's, which resamples the runs of each stratum by themselves, with a
    fixed seed (percentiles).

    Args:
        strata: figures of the runs on each scenario, (R_i,) each.

    Returns:
        The mean; no interval where a run is not finite, or where a stratum has only one.
    """
    all_runs = np.concatenate(list(strata))
    value = float(interquartile_mean(all_runs))
    every_run_equal = True
    for runs in strata:
        # One run resampled is that run: it shows no spread.
        if len(runs) < 2:
            return Estimate(value)
        if not np.isfinite(runs).all():
            return Estimate(value)
        if not _all_equal(runs, value):
            every_run_equal = False
    # Percentiles of equal numbers differ from them in the last bit on some processors.
    if every_run_equal:
        return Estimate(value, (value, value))

    def middle(*resampled: Array, axis: int) -> Any:
        drawn = np.concatenate(resampled, axis=axis)
        return interquartile_mean(drawn, axis)

    interval = _bootstrap(strata, middle, method="percentile")
    return Estimate(value, interval)


def td_error_mean(
    samples: Array,
    td_error: Array,
    updates: Array,
    window: int = TD_WINDOW,
) -> Array:
    """Root mean square TD error over the updates of the latest samples.

    Args:
        samples: where each row of a training's log ends, (K,).
        td_error: root mean square TD error of each row, (K,).
        updates: number of each row's updates, (K,).
        window: samples that count, up to and with those of the row; the first rows have fewer.

    Returns:
        (K,), NaN where there was no update.
    """
    # A row without an update has no error.
    counts = np.where(np.isfinite(td_error), updates, 0.0)
    errors = np.where(counts > 0, td_error, 0.0)
    row_squares = errors**2 * counts
    # Sums over a window are differences of sums from the start, which begin with 0.
    count_sums = _sums_from_start(counts)
    square_sums = _sums_from_start(row_squares)
    # Rows count that lie in the window whole: those from the first begin in it on.
    ends = np.append(0.0, samples)
    window_starts = samples - window
    first = np.searchsorted(ends, window_starts, side="left")
    n_updates = count_sums[1:] - count_sums[first]
    squares = square_sums[1:] - square_sums[first]
    # Rounding may leave a sum of squares below zero.
    squares = np.maximum(squares, 0.0)
    has_updates = n_updates > 0
    divisors = np.where(has_updates, n_updates, 1.0)
    window_errors = np.sqrt(squares / divisors)
    return np.where(has_updates, window_errors, np.nan)


def _sums_from_start(values: Array) -> Array:
    """Sums of the first 0, 1, …, K of K values, (K+1,)."""
    sums = np.cumsum(values)
    return np.append(0.0, sums)


def shown(
    value: float,
    ends: Sequence[float] | None = None,
    scale: float = 1.0,
    digits: int = 5,
) -> str:
    """`value [low, high]` for tables; `value` alone where there is no interval.

    Args:
        value: what is shown.
        ends: of its interval; None where there is none.
        scale: factor of all three numbers.
        digits: significant digits of the value; the interval's half width has two.
    """
    value *= scale
    places = decimals(value, digits)
    if ends is None:
        return f"{value:.{places}f}"
    low, high = (scale * end for end in ends)
    half_width = (high - low) / 2
    # All three with the same decimals: one compares them.
    places = max(places, decimals(half_width, 2))
    return f"{value:.{places}f} [{low:.{places}f}, {high:.{places}f}]"


def shown_estimate(value: float, ends: Interval, scale: float = 1.0) -> str:
    """`shown` with as many digits as the interval says mean anything; three without one.

    Args:
        value: what is shown.
        ends: of its interval.
        scale: factor of all three numbers.
    """
    digits = 3 if ends is None else 1
    return shown(value, ends, scale, digits)


def decimals(value: float, digits: int) -> int:
    """Decimals, 0 to 9, with which a number shows so many significant digits.

    Args:
        value: the number.
        digits: significant ones.
    """
    # Nine decimals would show nothing of a smaller number, but for its zeros.
    if not isfinite(value) or abs(value) < 0.5e-9:
        return 0
    # The power of ten of the first significant digit.
    first_digit = floor(log10(abs(value)))
    needed = digits - 1 - first_digit
    at_least_none = max(needed, 0)
    return min(at_least_none, 9)


def magnitude(reference: Array) -> Array:
    """The reference with the sign that makes its mean positive: a cost may be a profit."""
    is_profit = float(np.mean(reference)) < 0
    return -reference if is_profit else reference


def _t_interval(errors: Array, value: float) -> Interval:
    """Student's interval; None for fewer than two values, or where one is not finite."""
    count = len(errors)
    if count < 2:
        return None
    if not np.isfinite(errors).all():
        return None
    # Not by scipy.stats, which takes most of a second to import.
    quantile = stdtrit(count - 1, 0.5 + LEVEL / 2)
    deviation = np.std(errors, ddof=1)
    standard_error = deviation / np.sqrt(count)
    half = float(quantile * standard_error)
    low = value - half
    high = value + half
    return low, high


def paired_difference(
    cost: Array,
    other: Array,
    optimum: Array,
) -> tuple[float, Interval, float]:
    """Median over R pairs of runs of (J − J')/|J*|.

    p is that of the signed ranks of the pairs' differences when their signs are flipped (Wilcoxon's
    test by permutation): in all 2^R ways, or in 9999 drawn ones for more than 12 pairs.

    Args:
        cost: J of each run and noise seed, (R, S).
        other: J' of the counterparts, (R, S).
        optimum: J* on the same noise, (S,).

    Returns:
        The median, its interval over pairs and noise, and p, NaN for fewer than two pairs.
    """
    # Of each pair the mean over its noise.
    mean_differences = (cost - other).mean(axis=1)
    differences = mean_differences / magnitude(optimum).mean()
    # A cost that is no number is the worst.
    differences = np.where(np.isnan(differences), np.inf, differences)
    median = float(np.median(differences))
    interval = two_way(cost, optimum, other)
    probability = _sign_flip_probability(differences)
    return median, interval, probability


def _sign_flip_probability(differences: Array) -> float:
    """p of the signed ranks of R differences, (R,), when their signs are flipped."""
    count = len(differences)
    if count < 2:
        return float("nan")
    from scipy.stats import rankdata  # noqa: PLC0415 - most of a second

    sizes = np.abs(differences)
    ranks = rankdata(sizes)
    rank_sum = float(np.sign(differences) @ ranks)
    # Sums of ranks are multiples of a half: rounding must not decide.
    observed = abs(rank_sum) - 1e-9
    if count > EXHAUSTIVE_PAIRS:
        rng = np.random.default_rng(0)
        signs = rng.choice([-1.0, 1.0], size=(RESAMPLES, count))
        rank_sums = signs @ ranks
        reached = np.abs(rank_sums) >= observed
        # What was observed is one of the ways, too.
        n_reached = 1 + reached.sum()
        return float(n_reached / (1 + RESAMPLES))
    # Row k has the bits of k as signs.
    numbers = np.arange(2**count)[:, None]
    bits = (numbers >> np.arange(count)) & 1
    signs = 2.0 * bits - 1
    rank_sums = signs @ ranks
    reached = np.abs(rank_sums) >= observed
    return float(reached.mean())


def median_over_runs(values: Array) -> Estimate:
    """Median over R training runs.

    The interval is a bootstrap's, which resamples the runs with a fixed seed (percentiles).

    Args:
        values: a figure of each run, (R,); infinite of one that diverged.

    Returns:
        The median; no interval for one run, or where a value is no number.
    """
    value = float(np.median(values))
    count = len(values)
    if count < 2:
        return Estimate(value)
    # An infinite value has a rank, and so a percentile; a NaN has none.
    if np.isnan(values).any():
        return Estimate(value)
    rng = np.random.default_rng(0)
    drawn = rng.integers(count, size=(count, RESAMPLES))
    resampled = values[drawn]
    medians = np.median(resampled, axis=0)
    interval = _percentiles(medians)
    return Estimate(value, interval)


def _percentiles(resampled: Array) -> Interval:
    """Interval of resampled values, some of which may be infinite."""
    quantiles = (0.5 - LEVEL / 2, 0.5 + LEVEL / 2)
    # One of the values: between a finite and an infinite one lies none.
    low, high = np.quantile(resampled, quantiles, method="nearest")
    return float(low), float(high)


def two_way(
    cost: Array,
    optimum: Array,
    other: Array | None = None,
) -> Interval:
    """Interval of the median over R runs of (J − J')/|J*|, over runs and noise together.

    Runs and noise seeds are resampled independently (percentiles).

    Args:
        cost: J of each run and noise seed, (R, S).
        optimum: J* on the same noise, (S,).
        other: J', (R, S); else J*.

    Returns:
        None for one noise seed.
    """
    counterpart = optimum if other is None else other
    terms = cost - counterpart
    below = magnitude(optimum)
    n_runs, n_seeds = terms.shape
    if n_seeds < 2:
        return None
    rng = np.random.default_rng(0)
    fitting = AT_ONCE // n_seeds
    draws = max(1, min(RESAMPLES, fitting))
    # How often each seed is drawn, as a weight: a resampled mean is a product.
    equal = np.full(n_seeds, 1 / n_seeds)
    counts = rng.multinomial(n_seeds, equal, size=draws)
    weights = counts.T / n_seeds
    # An infinite cost stays one in every draw, where 0·∞ would be no number. Where the counterpart
    # alone is infinite the difference is minus infinity; a cost that is no number is the worst.
    finite = np.isfinite(terms).all(axis=1)
    infinite = np.nan_to_num(terms.sum(axis=1), nan=np.inf, posinf=np.inf, neginf=-np.inf)
    values = np.repeat(infinite[:, None], draws, axis=1)
    above = terms[finite] @ weights
    values[finite] = above / (below @ weights)
    # In each draw of the noise, as many runs as there are, with replacement.
    drawn = rng.integers(n_runs, size=(n_runs, draws))
    resampled = np.take_along_axis(values, drawn, axis=0)
    medians = np.median(resampled, axis=0)
    return _percentiles(medians)
