"""An evaluation at a glance: J with its intervals, and what it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from cosim.figures.pareto import FRONT, draw_pareto
from cosim.figures.regret import percent, regret_axis
from cosim.figures.style import REFERENCE, colors, figure, plain
from cosim.statistics import Estimate, regret, regret_terms
from cosim.statistics import mean as mean_of

Array = NDArray[np.float64]
VIOLATION = 1e-3
"""Violation per sample below which its axis is linear."""
DECADE = 10.0
"""Ratio of the costs from which their axis is logarithmic."""


@dataclass(frozen=True)
class Costs:
    """Figures of a controller over S noise seeds, (S,) each."""

    J: Array
    economic_cost: Array
    mean_violation: Array


def evaluation_figure(
    controllers: Mapping[str, Costs], *, title: str, optimal: Array | None = None
) -> Figure:
    """Left: J of each controller; right: economic cost against violation.

    Small dots are seeds, the large ones means with 95 % t intervals. `optimal` is J* (S,) on the
    same seeds: the left panel then shows the regret (J − J*)/|J*| in %, paired over the seeds.
    """
    color = colors(list(controllers))
    with figure(max(2.8, 0.27 * len(controllers) + 1.3)) as drawn:
        left, right = drawn.subplots(1, 2, width_ratios=(1.0, 1.05))
        _rows(left, controllers, color, optimal)
        points = {name: (c.mean_violation, c.economic_cost) for name, c in controllers.items()}
        draw_pareto(right, points, color)
        _violation_axis(right, np.concatenate([c.mean_violation for c in controllers.values()]))
        named = [line for line in right.lines if line.get_label() == FRONT]
        if named:
            right.legend(handles=named, loc="best")
        drawn.suptitle(plain(title), fontsize=8.5)
    return drawn


def _rows(
    axes: Axes, controllers: Mapping[str, Costs], color: Mapping[str, str], optimal: Array | None
) -> None:
    everything = []
    for row, (name, costs) in enumerate(controllers.items()):
        values, estimate = _shown(costs.J, optimal)
        everything.append(values)
        spread = np.linspace(-0.22, 0.22, len(values)) if len(values) > 1 else np.zeros(1)
        axes.plot(values, row + spread, ".", color=color[name], markersize=4, alpha=0.4, mew=0)
        if estimate.t is not None:
            axes.hlines(row, *estimate.t, color=color[name], linewidth=1.6, zorder=3)
        axes.plot(estimate.value, row, "o", color=color[name], markersize=5, zorder=4)
    axes.set_yticks(range(len(controllers)), [plain(name) for name in controllers])
    axes.set_ylim(len(controllers) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    values = np.concatenate(everything)
    if optimal is not None:
        axes.axvline(0.0, color=REFERENCE, linewidth=0.8, linestyle=(0, (4, 2)), zorder=1)
        regret_axis(axes, "x", np.append(values, 0.0))
        axes.set_xlabel("regret %, 95 % interval")
        return
    if float(values.min()) > 0 and float(values.max()) > DECADE * float(values.min()):
        axes.set_xscale("log")
    axes.set_xlabel("J per sample, 95 % interval")


def _violation_axis(axes: Axes, violation: Array) -> None:
    """Logarithmic from a thousandth on, where some controllers violate much and others hardly."""
    top = float(violation.max())
    if top < DECADE * VIOLATION:
        return
    axes.set_xscale("symlog", linthresh=VIOLATION, linscale=0.5)
    axes.set_xlim(-0.2 * VIOLATION, 1.6 * top)
    axes.xaxis.set_major_formatter(FuncFormatter(percent))


def _shown(cost: Array, optimal: Array | None) -> tuple[Array, Estimate]:
    """What the left panel shows of each seed, and of their mean."""
    if optimal is None:
        return cost, mean_of(cost)
    found = regret(cost, optimal)
    interval = None if found.t is None else (100 * found.t[0], 100 * found.t[1])
    return 100 * regret_terms(cost, optimal), Estimate(100 * found.value, interval)
