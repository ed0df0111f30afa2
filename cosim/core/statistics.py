"""The project's statistics: regret, gap closed, gain in J; means and intervals over seeds.

Every figure that a table, a log or a summary shows under one of these names comes from here. All
arrays are paired: entry s of each belongs to seed s. Intervals are of 95 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import floor, isfinite, log10
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

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
TD_WINDOW = 10_000
"""Samples over which a TD error is averaged (paper.tex, fig. nmpc_learn)."""


class Estimate(NamedTuple):
    """A value with its 95 % `interval` (low, high), None where nothing is known of its spread."""

    value: float
    interval: Interval = None


def mean(values: Array) -> Estimate:
    """Mean of S independent values, (S,), with Student's interval; none for one value."""
    value = float(np.mean(values))
    return Estimate(value, _t_interval(values, value))


def ratio(numerator: Array, denominator: Array) -> Estimate:
    """Ratio of the means of S paired values, (S,) each; NaN where the denominator's mean is zero.

    The interval is Student's of the linearised ratio (delta method): residuals (aₛ − r bₛ)/mean(b).
    """
    below = float(np.mean(denominator))
    value = float(np.mean(numerator)) / below if below else float("nan")
    with np.errstate(invalid="ignore"):  # an infinite cost has no interval
        residuals = (numerator - value * denominator) / (below or 1.0)
    return Estimate(value, _t_interval(residuals, value))


def bootstrapped(numerator: Array, denominator: Array) -> Interval:
    """BCa bootstrap interval of `ratio`, resampling seeds, for skewed costs.

    None for one seed, for more than `RESAMPLED`, and where a value is not finite.
    """
    seeds, total = len(numerator), np.sum(denominator)
    if not 2 <= seeds <= RESAMPLED or not np.isfinite(numerator).all() or not total:
        return None
    value = float(np.sum(numerator) / total)
    without = (np.sum(numerator) - numerator) / (total - denominator)
    # BCa is undefined where no seed counts.
    if np.ptp(without) <= NEGLIGIBLE * max(1.0, abs(value)):
        return value, value

    def quotient(above: Array, below: Array, axis: int) -> Any:
        return np.mean(above, axis=axis) / np.mean(below, axis=axis)

    return _bootstrap((numerator, denominator), quotient, paired=True, method="BCa")


def _bootstrap(data: Sequence[Array], statistic: Callable[..., Any], **options: Any) -> Interval:
    """Interval of a statistic of resampled data, with a fixed seed."""
    found = stats.bootstrap(
        tuple(data),
        statistic,
        n_resamples=RESAMPLES,
        batch=max(1, AT_ONCE // max(map(len, data))),
        confidence_level=LEVEL,
        rng=np.random.default_rng(0),
        **options,
    ).confidence_interval
    return float(found.low), float(found.high)


def regret(cost: Array, optimum: Array) -> Estimate:
    """(J − J*)/|J*|, as a ratio of means; `cost` and `optimum` (S,) are J of each seed."""
    return ratio(cost - optimum, magnitude(optimum))


def gain(cost: Array, reference: Array) -> Estimate:
    """Gain in J over a reference, (J_ref − J)/|J_ref|, as a ratio of means; both (S,)."""
    return ratio(reference - cost, magnitude(reference))


def gap_closed(cost: Array, naive: Array, optimum: Array) -> Estimate:
    """(J_naive − J)/(J_naive − J*), as a ratio of means; all (S,)."""
    return ratio(naive - cost, naive - optimum)


def regrets(cost: Array, optimum: Array | float) -> Array:
    """`regret` of each seed by itself, (S,)."""
    return relative(cost - optimum, optimum)


def relative(difference: Array, optimum: Array | float) -> Array:
    """Differences of costs in the unit of a regret, (J − J')/|J*| of each seed by itself, (S,)."""
    return _each(difference, np.abs(optimum))


def regret_terms(cost: Array, optimum: Array) -> Array:
    """Contribution (S,) of each seed or stretch to `regret`, their mean."""
    return (cost - optimum) / abs(np.mean(optimum))


def gains(cost: Array, reference: Array) -> Array:
    """`gain` of each seed by itself, (S,)."""
    return _each(reference - cost, np.abs(reference))


def gaps_closed(cost: Array, naive: Array, optimum: Array) -> Array:
    """`gap_closed` of each seed by itself, (S,)."""
    return _each(naive - cost, naive - optimum)


def _each(numerator: Array, denominator: Array | float) -> Array:
    """Quotients, NaN where the denominator is zero."""
    there = denominator != 0
    return np.where(there, numerator / np.where(there, denominator, 1.0), np.nan)


def interquartile_mean(values: Array, axis: int = -1) -> Any:
    """Mean of the middle half of R values along an axis, (R,) -> scalar.

    Entries at a quarter of R count with their share. Source: Agarwal et al., Deep RL at the Edge of
    the Statistical Precipice.
    """
    ordered = np.sort(np.moveaxis(values, axis, -1))
    count = ordered.shape[-1]
    weight = np.diff(np.clip(np.arange(count + 1), 0.25 * count, 0.75 * count))
    inside = np.where(weight > 0, ordered, 0.0)  # values outside may be infinite
    return (inside * weight).sum(axis=-1) / weight.sum()


def over_runs(strata: Sequence[Array]) -> Estimate:
    """Interquartile mean over training runs, each of `strata` (R_i,) one scenario's.

    The interval is a bootstrap's, which resamples the runs of each stratum by themselves, with a
    fixed seed (percentiles). None where a run is not finite, or where there is only one.
    """
    value = float(interquartile_mean(np.concatenate(list(strata))))
    if any(len(runs) < 2 for runs in strata) or not all(np.isfinite(r).all() for r in strata):
        return Estimate(value)
    # Percentiles of equal numbers differ from them in the last bit on some processors.
    if all(np.ptp(runs) <= NEGLIGIBLE * max(1.0, abs(value)) for runs in strata):
        return Estimate(value, (value, value))

    def middle(*resampled: Array, axis: int) -> Any:
        return interquartile_mean(np.concatenate(resampled, axis=axis), axis)

    return Estimate(value, _bootstrap(strata, middle, method="percentile"))


def td_error_mean(
    samples: Array, td_error: Array, updates: Array, window: int = TD_WINDOW
) -> Array:
    """Root mean square TD error over the updates of the `window` samples up to each row, (K,).

    `samples` (K,) is where a row of a training's log ends, `td_error` (K,) its root mean square
    over its `updates` (K,). The first rows average over fewer samples; NaN without an update.
    """
    counts = np.where(np.isfinite(td_error), updates, 0.0)
    squares = np.where(counts > 0, td_error, 0.0) ** 2 * counts
    total = np.pad(np.cumsum([squares, counts], axis=1), ((0, 0), (1, 0)))
    first = np.searchsorted(np.append(0.0, samples), samples - window, side="left")
    above, below = total[:, 1:] - total[:, first]
    mean = np.maximum(above, 0.0) / np.where(below > 0, below, 1.0)
    return np.where(below > 0, np.sqrt(mean), np.nan)


def shown(
    value: float, ends: Sequence[float] | None = None, scale: float = 1.0, digits: int = 5
) -> str:
    """`value [low, high]` for tables, scaled; `value` alone where there is no interval.

    The value keeps `digits` significant digits and the interval's half width two.
    """
    value *= scale
    if ends is None:
        return f"{value:.{decimals(value, digits)}f}"
    low, high = (scale * end for end in ends)
    places = max(decimals(value, digits), decimals((high - low) / 2, 2))
    return f"{value:.{places}f} [{low:.{places}f}, {high:.{places}f}]"


def decimals(value: float, digits: int) -> int:
    """Decimals, 0 to 9, with which a number shows `digits` significant digits."""
    if not isfinite(value) or value == 0:
        return 0
    return min(max(digits - 1 - floor(log10(abs(value))), 0), 9)


def magnitude(reference: Array) -> Array:
    """The reference with the sign that makes its mean positive: a cost may be a profit."""
    return -reference if float(np.mean(reference)) < 0 else reference


def _t_interval(residuals: Array, value: float) -> Interval:
    """Student's interval; None for fewer than two values, or where one is not finite."""
    if len(residuals) < 2 or not np.isfinite(residuals).all():
        return None
    half = float(stats.t.ppf(0.5 + LEVEL / 2, len(residuals) - 1) * stats.sem(residuals))
    return value - half, value + half


def paired_difference(cost: Array, other: Array, optimum: Array) -> tuple[float, Interval, float]:
    """Median over R pairs of runs of (J − J')/|J*|, its interval over pairs and noise, and p.

    `cost` and `other` are (R, S), `optimum` (S,). p is that of the signed ranks of the pairs'
    differences when their signs are flipped: all 2^R ways, or 9999 for more than 12 pairs. It is
    NaN for fewer than two pairs.
    """
    below = magnitude(optimum)
    each = (cost - other).mean(axis=1) / below.mean()
    each = np.where(np.isnan(each), np.inf, each)  # a cost that is no number is the worst
    ranks, count = stats.rankdata(np.abs(each)), len(each)
    if count > 12:
        flips = np.random.default_rng(0).choice([-1.0, 1.0], size=(RESAMPLES, count))
    else:
        flips = 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1) - 1
    reached = np.abs(flips @ ranks) >= abs(float(np.sign(each) @ ranks)) - 1e-9
    p = (1 + reached.sum()) / (1 + len(flips)) if count > 12 else reached.mean()
    interval = two_way(cost, optimum, other)
    return float(np.median(each)), interval, float(p) if count > 1 else float("nan")


def two_way(cost: Array, optimum: Array, other: Array | None = None) -> Interval:
    """Interval of the median over R runs of (J − J')/|J*|, over runs and noise together.

    `cost` (R, S) is J of each run and noise seed, `optimum` (S,) J* on the same noise, `other` J',
    (R, S), else J*. Runs and noise seeds are resampled independently (percentiles). None for one
    seed.
    """
    terms, below = cost - (optimum if other is None else other), magnitude(optimum)
    runs, seeds = terms.shape
    if seeds < 2:
        return None
    rng, draws = np.random.default_rng(0), max(1, min(RESAMPLES, AT_ONCE // seeds))
    weights = rng.multinomial(seeds, np.full(seeds, 1 / seeds), size=draws).T / seeds
    finite = np.isfinite(terms).all(axis=1)
    values = np.full((runs, draws), np.inf)
    values[finite] = terms[finite] @ weights / (below @ weights)
    rows = rng.integers(runs, size=(runs, draws))
    middle = np.median(np.take_along_axis(values, rows, axis=0), axis=0)
    low, high = np.quantile(middle, (0.5 - LEVEL / 2, 0.5 + LEVEL / 2), method="nearest")
    return float(low), float(high)
