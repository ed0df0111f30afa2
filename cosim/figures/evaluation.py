"""An evaluation at a glance: J or regret with intervals, and how often bounds are violated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.core.protocols import Array
from cosim.core.statistics import Estimate, regret, regret_terms
from cosim.core.statistics import mean as mean_of
from cosim.figures.style import (
    DASHED,
    NARROW,
    REFERENCE,
    WIDTH,
    DotRow,
    LineStyle,
    ask,
    dot_rows,
    figure,
    palette,
    plain,
    regret_axis,
)

SHARE_FLOOR = 1.0
"""Share of violating samples in % below which its axis is linear."""
DECADE = 10.0
"""Ratio of the costs from which their axis is logarithmic."""
SEED_FLOOR = 0.1
"""Regret in % of single seeds below which its axis is linear."""


def evaluation_figure(
    controllers: Mapping[str, pd.DataFrame],
    *,
    title: str,
    optimal: Array | None = None,
    width: float = WIDTH,
) -> Figure:
    """J of each controller, or its regret, and its share of violating samples.

    Dots are seeds, bars their means with Student's interval.

    Args:
        controllers: columns `J` and `violating_share`, a row for each of S seeds, by the
            controller's name.
        title: says what was evaluated.
        optimal: J* (S,) on the same seeds; the regret (J − J*)/|J*| in % is then shown in place of
            J, paired over the seeds.
        width: in inches; panels of a narrow figure stand below each other.
    """
    styles = palette(list(controllers))
    is_narrow = width < NARROW
    height = max(1.7, 0.27 * len(controllers) + 0.7)
    shape = (2, 1) if is_narrow else (1, 2)
    with figure(height * shape[0] + 0.7, width) as drawn:
        left, right = drawn.subplots(*shape, sharey=True)
        _draw_costs(left, controllers, styles, optimal)
        _draw_violations(right, controllers, styles)
        ask(
            drawn,
            "Which controller costs least without violating bounds?",
            f"{plain(title)}. Dots: seeds. Bars: mean and 95 % interval.",
        )
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
        regret_axis(axes, "x", _reached(rows), SEED_FLOOR)
        axes.set_xlabel("regret %: cost above the least possible")
        return
    least = float(values.min())
    most = float(values.max())
    # A plant that earns money has costs below zero, of which there is no logarithm.
    if least > 0 and most > DECADE * least:
        axes.set_xscale("log")
    axes.set_xlabel("J per sample: economic cost and penalty")


def _reached(rows: Sequence[DotRow]) -> Array:
    """What an axis from 0 on must show of rows: their values and the intervals' upper ends."""
    reached = [np.zeros(1)]
    for row in rows:
        # Lower ends may be below 0, and the axis need not reach them.
        reached += [row.values, np.array([row.high])]
    return np.concatenate(reached)


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


def _draw_violations(
    axes: Axes,
    controllers: Mapping[str, pd.DataFrame],
    styles: Mapping[str, LineStyle],
) -> None:
    """A row of dots for each controller: the share of samples that violate a bound."""
    rows = []
    for name, costs in controllers.items():
        shares = costs.violating_share.to_numpy()
        rows.append(_dots(name, 100 * shares, mean_of(shares), scale=100.0))
    dot_rows(axes, rows, styles)
    regret_axis(axes, "x", _reached(rows), SHARE_FLOOR)
    axes.set_xlabel("samples that violate a bound, %")
