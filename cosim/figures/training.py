"""What a training leaves to look at: cost, violation, TD error and θ over its samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter
from numpy.typing import NDArray

from cosim.figures.labels import EndLabel, label_ends
from cosim.figures.regret import cost_axis, percent
from cosim.figures.style import REFERENCE, SERIES, figure, plain, symbol
from cosim.statistics import regrets

Array = NDArray[np.float64]
GREEDY, TRAINING = SERIES[0], SERIES[1]
DECADES = 30.0
"""Ratio of the largest to the smallest value from which an axis is logarithmic."""
POINTS = 30
"""Fewer values than this are marked one by one."""
_LINE: Any = {"markersize": 3, "linewidth": 1.2, "clip_on": False}
BLOCKS = 4
"""Blocks of θ that are drawn, at most: those that moved most."""


def training_figure(
    log: Mapping[str, Array],
    theta: Mapping[str, Array],
    baselines: Mapping[str, float],
    *,
    title: str,
    start: float = float("nan"),
    optimum: str = "optimal",
) -> Figure:
    """Cost, violation, TD error and θ over a training's samples.

    `log` has columns (K,) of the training's log, NaN where not measured: `samples`, `J` of the
    training samples since the row before, `greedy_J` and `greedy_violating_share` of the policy,
    `td_error`; `start` is the greedy J before the first. `theta` maps a block's name to its
    increments since the start in units of its learning scale, (K, entries). `baselines` are J by
    controller on the greedy policy's noise; the one called `optimum` is J*, and costs are then
    shown as regret (J − J*)/|J*|.
    """
    best = baselines.get(optimum)
    panels: list[tuple[str, Callable[[Axes], list[EndLabel]]]] = [
        (
            "regret %" if best is not None else "J per sample",
            lambda a: _cost(a, log, start, baselines, best),
        )
    ]
    if _measured(log, "greedy_violating_share"):
        panels.append(("greedy: violating samples %", lambda a: _violation(a, log)))
    # A single one says nothing of a course.
    if _measured(log, "td_error", 2):
        panels.append(("TD error (r.m.s.)", lambda a: _td_error(a, log)))
    if moved := _most_moved(theta):
        panels.append(("change of θ, by its scale", lambda a: _change(a, log, moved)))
    columns = len(panels) if len(panels) < 4 else 2
    rows = -(-len(panels) // columns)
    with figure(2.15 * rows + 0.35) as drawn:
        grid = drawn.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        end = max(float(log["samples"][-1]), 1.0)
        named = []
        for axes, (label, draw) in zip(grid, panels, strict=True):
            named.append((axes, draw(axes)))
            axes.set_title(label, loc="left", fontsize=8.0)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.set_xlim(0.0, end)
        for axes in grid[-columns:]:
            axes.set_xlabel("training samples")
        drawn.suptitle(plain(title), fontsize=8.5)
        drawn.draw_without_rendering()
        for axes, labels in named:
            label_ends(axes, labels)
    return drawn


def _measured(log: Mapping[str, Array], name: str, least: int = 1) -> bool:
    return name in log and int(np.isfinite(log[name]).sum()) >= least


def _known(log: Mapping[str, Array], name: str) -> tuple[Array, Array]:
    known = np.isfinite(log[name])
    return log["samples"][known], log[name][known]


def _cost(
    axes: Axes,
    log: Mapping[str, Array],
    start: float,
    baselines: Mapping[str, float],
    best: float | None,
) -> list[EndLabel]:
    def shown(cost: Array | float) -> Array:
        values = np.asarray(cost, dtype=np.float64)
        return values if best is None else 100 * regrets(values, best)

    labels, everything = [], [shown(level) for level in baselines.values()]
    for name, color, text in (("J", TRAINING, "training"), ("greedy_J", GREEDY, "greedy")):
        samples, cost = _known(log, name)
        if name == "greedy_J" and np.isfinite(start):
            samples, cost = np.append(0.0, samples), np.append(start, cost)
        if not cost.size:
            continue
        marker = "o" if name == "greedy_J" else ""
        values = shown(cost)
        axes.plot(samples, values, marker=marker, color=color, **_LINE)
        labels.append(EndLabel(text, float(values[-1]), color))
        everything.append(values)
    for name, level in baselines.items():
        axes.axhline(float(shown(level)), color=REFERENCE, linewidth=0.8, linestyle=(0, (4, 2)))
        labels.append(EndLabel(plain(name), float(shown(level)), REFERENCE))
    values = np.concatenate([np.ravel(values) for values in everything])
    cost_axis(axes, values, relative=best is not None)
    return labels


def _violation(axes: Axes, log: Mapping[str, Array]) -> list[EndLabel]:
    samples, share = _known(log, "greedy_violating_share")
    axes.plot(samples, 100 * share, marker="o", color=GREEDY, **_LINE)
    axes.set_ylim(
        -0.04 * max(100 * float(share.max()), 1.0), 1.1 * max(100 * float(share.max()), 1)
    )
    return []


def _td_error(axes: Axes, log: Mapping[str, Array]) -> list[EndLabel]:
    samples, error = _known(log, "td_error")
    axes.plot(samples, error, marker="." if len(error) < POINTS else "", color=TRAINING, **_LINE)
    axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    if float(error.min()) > 0 and error.max() > DECADES * error.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(0.0, 1.08 * max(float(error.max()), 1e-12))
    return []


def _most_moved(theta: Mapping[str, Array]) -> dict[str, Array]:
    """Norm (K,) of the increments of the blocks that moved most, most first."""
    norms = {name: np.linalg.norm(values, axis=1) for name, values in theta.items()}
    moved = {name: norm for name, norm in norms.items() if norm.any()}
    order = sorted(moved, key=lambda name: -float(moved[name][-1]))
    return {name: moved[name] for name in order[:BLOCKS]}


def _change(axes: Axes, log: Mapping[str, Array], moved: Mapping[str, Array]) -> list[EndLabel]:
    samples = np.concatenate([[0.0], log["samples"]])
    labels = []
    for color, (name, norm) in zip(SERIES, moved.items(), strict=False):
        axes.plot(samples, np.concatenate([[0.0], norm]), color=color, linewidth=1.2)
        labels.append(EndLabel(symbol(name), float(norm[-1]), color))
    top = max(float(norm.max()) for norm in moved.values())
    if top > DECADES:
        axes.set_yscale("symlog", linthresh=1.0)
        axes.yaxis.set_major_formatter(FuncFormatter(percent))
    axes.set_ylim(0.0, 1.05 * top)
    return labels
