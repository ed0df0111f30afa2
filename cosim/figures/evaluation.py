"""An evaluation at a glance: J or regret with intervals, and economic cost against violation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter

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
from cosim.protocols import Array
from cosim.statistics import mean as mean_of
from cosim.statistics import regret, regret_terms

VIOLATION = 1e-3
"""Violation per sample below which its axis is linear."""
DECADE = 10.0
"""Ratio of the costs from which their axis is logarithmic."""
FLOOR = 0.1
"""Regret in % of single seeds below which its axis is linear."""


def evaluation_figure(
    controllers: Mapping[str, pd.DataFrame], *, title: str, optimal: Array | None = None
) -> Figure:
    """Left: J of each controller; right: economic cost against violation.

    `controllers` have the columns `J`, `economic_cost` and `mean_violation`, a row for each seed.
    Dots are seeds, bars and large dots means with 95 % t intervals. `optimal` is J* (S,) on the
    same seeds: the left panel then shows the regret (J − J*)/|J*| in %, paired over the seeds.
    The grey line joins the controllers that no other one beats in both cost and violation.
    """
    styles = palette(list(controllers))
    with figure(max(2.8, 0.27 * len(controllers) + 1.3)) as drawn:
        left, right = drawn.subplots(1, 2, width_ratios=(1.0, 1.05))
        _rows(left, controllers, styles, optimal)
        _pareto(right, controllers, styles)
        drawn.suptitle(plain(title))
    return drawn


def _rows(
    axes: Axes,
    controllers: Mapping[str, pd.DataFrame],
    styles: Mapping[str, LineStyle],
    optimal: Array | None,
) -> None:
    rows = []
    for name, costs in controllers.items():
        values, scale = costs.J.to_numpy(), 1.0
        estimate = mean_of(values)
        if optimal is not None:
            estimate, scale = regret(values, optimal), 100.0
            values = 100 * regret_terms(values, optimal)
        ends = (scale * end for end in estimate.interval or ())
        finished = np.ones(len(values), dtype=bool)
        rows.append(DotRow(name, values, finished, scale * estimate.value, *ends))
    values = dot_rows(axes, rows, styles)
    if optimal is not None:
        axes.axvline(0.0, color=REFERENCE, linewidth=0.8, linestyle=DASHED, zorder=1)
        regret_axis(axes, "x", np.append(values, 0.0), FLOOR)
        axes.set_xlabel("regret %, 95 % interval")
        return
    if float(values.min()) > 0 and float(values.max()) > DECADE * float(values.min()):
        axes.set_xscale("log")
    axes.set_xlabel("J per sample, 95 % interval")


def _pareto(
    axes: Axes, controllers: Mapping[str, pd.DataFrame], styles: Mapping[str, LineStyle]
) -> None:
    means = {
        name: (float(np.mean(c.mean_violation)), float(np.mean(c.economic_cost)))
        for name, c in controllers.items()
    }
    ends = set(means.values())
    front = [
        one for one in sorted(ends)
        if not any(other != one and np.less_equal(other, one).all() for other in ends)
    ]  # fmt: skip
    if len(front) > 1:
        text = "no other is better in both"
        axes.plot(*np.array(front).T, color=REFERENCE, linewidth=0.9, linestyle=DASHED, label=text)
        axes.legend(loc="best")
    for name, costs in controllers.items():
        color = styles[name].color
        axes.plot(
            costs.mean_violation, costs.economic_cost, ".", color=color, ms=3, alpha=0.35, mew=0
        )
        axes.errorbar(
            *means[name], xerr=_half_width(costs.mean_violation),
            yerr=_half_width(costs.economic_cost), fmt="o", color=color, markersize=5,
            capsize=2, linewidth=1.0,
        )  # fmt: skip
    top = max(float(costs.mean_violation.max()) for costs in controllers.values())
    if top >= DECADE * VIOLATION:
        axes.set_xscale("symlog", linthresh=VIOLATION, linscale=0.5)
        axes.set_xlim(-0.2 * VIOLATION, 1.6 * top)
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.set_xlabel("mean violation per sample, in the states' units")
    axes.set_ylabel("economic cost per sample")


def _half_width(values: pd.Series[float]) -> float:
    estimate = mean_of(values.to_numpy())
    return 0.0 if estimate.interval is None else (estimate.interval[1] - estimate.interval[0]) / 2
