"""Economic cost against violation: what a controller pays for keeping the bounds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.stats import t as student

from cosim.figures.style import REFERENCE, colors, figure, plain, save

Array = NDArray[np.float64]
XLABEL = "mean violation per sample, in the states' units"
YLABEL = "economic cost per sample"
FRONT = "no other is better in both"


def plot_pareto(
    points: Mapping[str, tuple[Array, Array]],
    path: str | Path,
    *,
    xlabel: str = XLABEL,
    ylabel: str = YLABEL,
) -> Path:
    """Draw `draw_pareto` to a PNG or SVG file, with a legend; raises FigureError as `save` does."""
    with figure(3.0, 4.6) as drawn:
        axes = drawn.subplots()
        draw_pareto(axes, points, colors(list(points)), xlabel=xlabel, ylabel=ylabel)
        axes.legend(loc="best")
    return save(drawn, path)


def draw_pareto(
    axes: Axes,
    points: Mapping[str, tuple[Array, Array]],
    color: Mapping[str, str],
    *,
    xlabel: str = XLABEL,
    ylabel: str = YLABEL,
) -> None:
    """Draw controllers by (violation (S,), economic cost (S,)) over S seeds.

    Small dots are seeds, the large ones means with 95 % t intervals. The grey line joins the
    controllers that no other one beats in both.
    """
    means = {name: (float(np.mean(v)), float(np.mean(c))) for name, (v, c) in points.items()}
    front = nondominated(np.array(list(means.values())))
    best = sorted(mean for mean, keep in zip(means.values(), front, strict=True) if keep)
    if len(best) > 1:
        axes.plot(
            *np.array(best).T, color=REFERENCE, linewidth=0.9, linestyle=(0, (4, 2)), label=FRONT
        )
    for name, (violation, cost) in points.items():
        axes.plot(violation, cost, ".", color=color[name], markersize=3, alpha=0.35, mew=0)
        axes.errorbar(
            *means[name],
            xerr=half_width(violation),
            yerr=half_width(cost),
            fmt="o",
            color=color[name],
            markersize=5,
            capsize=2,
            linewidth=1.0,
            label=plain(name),
        )
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)


def half_width(values: Array, level: float = 0.95) -> float:
    """Half the t interval of the mean of S independent values; 0 for one value."""
    seeds = len(values)
    if seeds < 2:
        return 0.0
    error = np.std(values, ddof=1) / np.sqrt(seeds)
    return float(student.ppf(0.5 + level / 2, seeds - 1) * error)


def nondominated(points: Array) -> NDArray[np.bool_]:
    """Which of the points (K, d) no other one beats: none is as low in all and lower in one."""
    lower = np.all(points[None] <= points[:, None], axis=2)
    strictly = np.any(points[None] < points[:, None], axis=2)
    beaten: NDArray[np.bool_] = np.any(lower & strictly, axis=1)
    return ~beaten
