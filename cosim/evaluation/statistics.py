"""Intervals over seeds, for means and for ratios of means, by two independent methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

LEVEL = 0.95
RESAMPLES = 9999


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % intervals, (low, high): Student's t, and BCa bootstrap over seeds.

    The intervals are None where one seed, or none of the two methods, can say anything.
    """

    value: float
    t: tuple[float, float] | None
    bootstrap: tuple[float, float] | None

    def to_dict(self) -> dict[str, Any]:
        """As a JSON document."""
        return asdict(self)


def mean(values: Array) -> Estimate:
    """Mean of S independent values, (S,); without intervals where one is not finite."""
    if not np.all(np.isfinite(values)):
        return Estimate(float(np.mean(values)), None, None)
    return Estimate(
        float(np.mean(values)),
        _t_interval(values, float(np.mean(values))),
        _bootstrap((values,), lambda x, axis: np.mean(x, axis=axis)),
    )


def ratio(numerator: Array, denominator: Array) -> Estimate:
    """Ratio of the means of S paired values, (S,) each; e.g. an economic gain, or a gap closed.

    The t interval is that of the linearised ratio (delta method): residuals (aₛ − r bₛ)/mean(b).
    NaN without intervals where the denominator's mean is zero.
    """
    below, value = float(np.mean(denominator)), quotient(numerator, denominator)
    if not np.isfinite(value):
        return Estimate(value, None, None)
    return Estimate(
        value,
        _t_interval((numerator - value * denominator) / below, value),
        _bootstrap(
            (numerator, denominator),
            lambda a, b, axis: np.mean(a, axis=axis) / np.mean(b, axis=axis),
        ),
    )


def shown(value: float, ends: Sequence[float] | None, scale: float = 1.0, digits: int = 2) -> str:
    """`value [low, high]` for tables, scaled and rounded; `value` where there is no interval."""
    text = f"{scale * value:.{digits}f}"
    if ends is None:
        return text
    low, high = (f"{scale * end:.{digits}f}" for end in ends)
    return f"{text} [{low}, {high}]"


def quotient(numerator: Array, denominator: Array) -> float:
    """Ratio of the means alone; NaN where the denominator's is zero."""
    below = float(np.mean(denominator))
    return float(np.mean(numerator)) / below if below else float("nan")


def _t_interval(residuals: Array, value: float) -> tuple[float, float] | None:
    if len(residuals) < 2:
        return None
    half = float(stats.t.ppf(0.5 + LEVEL / 2, len(residuals) - 1) * stats.sem(residuals))
    return value - half, value + half


def _bootstrap(samples: Sequence[Array], statistic: Any) -> tuple[float, float] | None:
    """BCa interval with a fixed seed: the same values give the same interval."""
    seeds = len(samples[0])
    if seeds < 2:
        return None
    value = float(statistic(*samples, axis=-1))
    jackknife = [statistic(*(np.delete(x, s) for x in samples), axis=-1) for s in range(seeds)]
    # BCa is undefined for a statistic that no seed moves; its interval is the point.
    if np.ptp(jackknife) <= 1e-12 * max(1.0, abs(value)):
        return value, value
    result = stats.bootstrap(
        samples,
        statistic,
        paired=True,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="BCa",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(result.low), float(result.high)
