"""An evaluation at a glance: J or regret with intervals, and economic cost against violation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter

from cosim.core.protocols import Array
from cosim.core.statistics import Estimate, regret, regret_terms
from cosim.core.statistics import mean as mean_of
from cosim.figures.style import (
    DASHED,
    REFERENCE,
    DotRow,
    LineStyle,
    dot_rows,
    figure,
    palette,
    plain,
    regret_axis,
)

VIOLATION = 1e-3
"""Violation per sample below which its axis is linear."""
DECADE = 10.0
"""Ratio of the costs from which their axis is logarithmic."""
SEED_FLOOR = 0.1
"""Regret in % of single seeds below which its axis is linear."""


def evaluation_figure(
    controllers: Mapping[str, pd.DataFrame],
    *,
    title: str,
    optimal: Array | None = None,
) -> Figure:
    """Left: J of each controller; right: economic cost against violation.

    Dots are seeds, bars and large dots means with 95 % t intervals. The grey line joins the
    controllers that no other one beats in both cost and violation.

    Args:
        controllers: columns `J`, `economic_cost` and `mean_violation`, a row for each of S seeds,
            by the controller's name.
        title: of the figure.
        optimal: J* (S,) on the same seeds; the left panel then shows the regret (J − J*)/|J*| in %,
            paired over the seeds.
    """
    styles = palette(list(controllers))
    with figure(max(2.8, 0.27 * len(controllers) + 1.3)) as drawn:
        left, right = drawn.subplots(1, 2, width_ratios=(1.0, 1.05))
        _draw_costs(left, controllers, styles, optimal)
        _draw_pareto(right, controllers, styles)
        drawn.suptitle(plain(title))
    return drawn


def _draw_costs(
    axes: Axes,
    controllers: Mapping[str, pd.DataFrame],
    styles: Mapping[str, LineStyle],
    optimal: Array | None,
) -> None:
    """A row of dots for each controller: J, or its regret where J* is known."""
    rows = []
    for name, costs in controllers.items():
        values = costs.J.to_numpy()
        if optimal is None:
            rows.append(_dots(name, values, mean_of(values)))
        else:
            # The seeds' terms, not their own regrets: a mean of these is not the regret.
            in_percent = 100 * regret_terms(values, optimal)
            estimate = regret(values, optimal)
            rows.append(_dots(name, in_percent, estimate, scale=100.0))
    values = dot_rows(axes, rows, styles)
    if optimal is not None:
        axes.axvline(0.0, color=REFERENCE, linewidth=0.8, linestyle=DASHED, zorder=1)
        regret_axis(axes, "x", np.append(values, 0.0), SEED_FLOOR)
        axes.set_xlabel("regret %, 95 % interval")
        return
    least = float(values.min())
    most = float(values.max())
    # A plant that earns money has costs below zero, of which there is no logarithm.
    if least > 0 and most > DECADE * least:
        axes.set_xscale("log")
    axes.set_xlabel("J per sample, 95 % interval")


def _dots(name: str, values: Array, estimate: Estimate, scale: float = 1.0) -> DotRow:
    """A controller's values (S,) and their mean with its interval, which is multiplied."""
    low, high = estimate.interval or (np.nan, np.nan)
    return DotRow(
        name,
        values,
        finished=np.ones(len(values), dtype=bool),
        middle=scale * estimate.value,
        low=scale * low,
        high=scale * high,
    )


def _draw_pareto(
    axes: Axes,
    controllers: Mapping[str, pd.DataFrame],
    styles: Mapping[str, LineStyle],
) -> None:
    """Economic cost against violation of each controller, and the line of the best of both."""
    means = {}
    for name, costs in controllers.items():
        violation = float(np.mean(costs.mean_violation))
        economic_cost = float(np.mean(costs.economic_cost))
        means[name] = (violation, economic_cost)
    front = _pareto_front(set(means.values()))
    # A single controller is better than all others: there is no line to draw.
    if len(front) > 1:
        violations, economic_costs = zip(*front, strict=True)
        axes.plot(
            violations,
            economic_costs,
            color=REFERENCE,
            linewidth=0.9,
            linestyle=DASHED,
            label="no other is better in both",
        )
        axes.legend(loc="best")
    # Dots of the seeds below the means of all.
    for name, costs in controllers.items():
        color = styles[name].color
        axes.plot(
            costs.mean_violation,
            costs.economic_cost,
            ".",
            color=color,
            markersize=3,
            markeredgewidth=0,
            alpha=0.35,
        )
        axes.errorbar(
            *means[name],
            xerr=_half_width(costs.mean_violation),
            yerr=_half_width(costs.economic_cost),
            fmt="o",
            color=color,
            markersize=5,
            capsize=2,
            linewidth=1.0,
        )
    top = max(float(costs.mean_violation.max()) for costs in controllers.values())
    # Linear near 0, where controllers are that never violate a bound.
    if top >= DECADE * VIOLATION:
        axes.set_xscale("symlog", linthresh=VIOLATION, linscale=0.5)
        axes.set_xlim(-0.2 * VIOLATION, 1.6 * top)
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.set_xlabel("mean violation per sample, in the states' units")
    axes.set_ylabel("economic cost per sample")


def _pareto_front(points: set[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that no other one is below in both coordinates, by the first coordinate."""
    front = []
    for point in sorted(points):
        others = points - {point}
        # Points are a set: no other one is equal in both.
        is_beaten = any(np.less_equal(other, point).all() for other in others)
        if not is_beaten:
            front.append(point)
    return front


def _half_width(values: pd.Series[float]) -> float:
    """Half of the mean's 95 % interval; 0 of a single value."""
    estimate = mean_of(values.to_numpy())
    if estimate.interval is None:
        return 0.0
    low, high = estimate.interval
    return (high - low) / 2
