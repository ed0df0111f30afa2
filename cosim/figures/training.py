"""A training over its samples: cost, violations, TD error and θ; and the paper's figure of it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, FormatStrFormatter

from cosim.core.protocols import Array
from cosim.core.statistics import TD_WINDOW, regrets
from cosim.figures.style import (
    DASHED,
    ENTRIES,
    INK,
    NARROW,
    WIDTH,
    CostLine,
    EndLabel,
    ask,
    cost_lines,
    figure,
    label_ends,
    palette,
    plain,
    samples_axis,
    symbol,
)

LEARNED_COLOR = palette(["learned"])["learned"].color
DECADES = 30.0
"""Ratio of the largest to the smallest value from which an axis is logarithmic."""
POINTS = 30
"""Fewer values than this are marked one by one."""
BLOCKS = 4
"""Blocks of θ that are drawn, at most: those that moved most."""
PANEL_COLUMNS = 4
"""Panels beside each other in the paper's figure; half of them in a narrow one."""
PANEL_TITLE_SIZE = 8.0
"""Size in points of a panel's title."""
Panel = Callable[[Axes], Sequence[EndLabel]]
"""Draws a panel on its axes and returns the names at its lines' ends."""
# A marker at the edge of the axes is drawn whole.
_LINE: Any = {
    "markersize": 3,
    "linewidth": 1.2,
    "clip_on": False,
}
# Of what is known where the policy was judged, and nowhere between: a line would tell of progress.
_JUDGED: Any = {
    "marker": "o",
    "color": LEARNED_COLOR,
    "linestyle": (0, (1, 2)),
    "linewidth": 0.8,
}
# Of the entries of a block, in turn: solid in every colour, then dashed.
_ENTRY_LOOKS: list[dict[str, Any]] = []
for _line, _color in product(("-", DASHED), ENTRIES):
    _ENTRY_LOOKS.append({"linestyle": _line, "color": _color})


def training_figure(
    log: Mapping[str, Array],
    theta: Mapping[str, Array],
    baselines: Mapping[str, float],
    *,
    title: str,
    width: float = WIDTH,
) -> Figure:
    """Cost, violation, TD error and θ over a training's samples.

    Args:
        log: columns (K,) of the training's log, from sample 0 on, NaN where not measured:
            `samples`, `J` of the training samples since the row before, `greedy_J` and
            `greedy_violating_share` of the policy, `td_error`.
        theta: a block's increments since the start in units of its learning scale, (K, entries), by
            its name.
        baselines: J by controller on the greedy policy's noise; `optimal` is J*, and costs are then
            shown as regret (J − J*)/|J*|.
        title: says which training it is, and how it ended.
        width: in inches; panels of a narrow figure stand below each other.
    """
    panels = _training_panels(log, theta, baselines)
    # Four panels make a square; up to three a row.
    columns = len(panels) if len(panels) < 4 else 2
    if width < NARROW:
        columns = 1
    rows = -(-len(panels) // columns)
    # A training may have ended before its first sample.
    end = max(float(log["samples"][-1]), 1.0)
    with figure(2.0 * rows + 0.7, width) as drawn:
        grid = drawn.subplots(rows, columns, sharex=True, squeeze=False)
        labels = []
        for axes, (name, draw) in zip(grid.flat, panels.items(), strict=True):
            labels.append((axes, draw(axes)))
            _set_title(axes, name, width / columns)
            samples_axis(axes, end)
        for axes in grid[-1]:
            axes.set_xlabel("training samples")
        ask(drawn, "Did the controller become better while it learned?", plain(title))
        label_ends(drawn, labels)
    return drawn


def _set_title(axes: Axes, title: str, width: float) -> None:
    """Write a title above axes, from their left edge, in lines that fit a width in inches."""
    # A letter is about half as wide as it is high; a fifth of the width is beside the axes.
    characters = int(0.8 * 72 * width / (0.52 * PANEL_TITLE_SIZE))
    axes.set_title(textwrap.fill(title, characters), loc="left", fontsize=PANEL_TITLE_SIZE)


def _training_panels(
    log: Mapping[str, Array],
    theta: Mapping[str, Array],
    baselines: Mapping[str, float],
) -> dict[str, Panel]:
    """Drawing functions of the panels of a training, by title, for the known quantities.

    Args:
        log: columns (K,) of the training's log.
        theta: a block's increments, (K, entries), by its name.
        baselines: J by controller on the greedy policy's noise.
    """
    panels: dict[str, Panel] = {}
    best = baselines.get("optimal")
    title_of_cost = "J per sample" if best is None else "regret %: cost above the least possible"
    panels[title_of_cost] = partial(
        _draw_cost,
        log=log,
        baselines=baselines,
        best=best,
    )
    samples, share = _known(log, "greedy_violating_share")
    if share.size:
        panels["samples that violate a bound, %, greedy"] = partial(
            _draw_course,
            samples=samples,
            values=100 * share,
            least=1.0,
            **_JUDGED,
        )
    samples, error = _known(log, "td_error")
    # A single error makes no curve.
    if error.size > 1:
        panels["TD error, r.m.s.: how wrong Q is"] = partial(
            _draw_course,
            samples=samples,
            values=error,
            least=1e-12,
            color=INK,
        )
    moved = _most_moved(theta)
    if moved:
        panels["how far θ has moved, by its scale"] = partial(
            _draw_change,
            samples=log["samples"],
            moved=moved,
        )
    return panels


def _most_moved(theta: Mapping[str, Array]) -> dict[str, Array]:
    """Norm of the increments (K,) of the blocks that moved most, the farthest first."""
    norms = {}
    for name, increments in theta.items():
        norm = np.linalg.norm(increments, axis=1)
        if norm.any():
            norms[name] = norm

    def end_of(name: str) -> float:
        return float(norms[name][-1])

    # Stable, and by the negative number: blocks that moved equally far stay in θ's order.
    farthest_first = sorted(norms, key=lambda name: -end_of(name))
    return {name: norms[name] for name in farthest_first[:BLOCKS]}


def _known(log: Mapping[str, Array], name: str) -> tuple[Array, Array]:
    """Samples and finite values of a column; empty where the log has none."""
    samples = log["samples"]
    nowhere = np.full(len(samples), np.nan)
    values = log.get(name, nowhere)
    is_known = np.isfinite(values)
    return samples[is_known], values[is_known]


def _draw_cost(
    axes: Axes,
    log: Mapping[str, Array],
    baselines: Mapping[str, float],
    best: float | None,
) -> list[EndLabel]:
    """Cost of the training samples and of the greedy policy, as regret where J* is known."""

    def shown(cost: Array | float) -> Array:
        values = np.asarray(cost, dtype=np.float64)
        if best is None:
            return values
        return 100 * regrets(values, best)

    lines = []
    samples, cost = _known(log, "J")
    if cost.size:
        # Each is a mean over the samples since the row before, and a line of that length.
        begin = log["samples"][log["samples"] < samples[0]][-1:]
        look = _LINE | {"color": INK, "drawstyle": "steps-pre"}
        costs = shown(np.append(cost[: len(begin)], cost))
        lines.append(CostLine("training", np.append(begin, samples), costs, look))
    samples, cost = _known(log, "greedy_J")
    if cost.size:
        look = _LINE | _JUDGED
        lines.append(CostLine("greedy", samples, shown(cost), look))
    levels = {name: float(shown(level)) for name, level in baselines.items()}
    return cost_lines(axes, lines, levels, relative=best is not None)


def _draw_course(
    axes: Axes,
    samples: Array,
    values: Array,
    least: float,
    **look: Any,
) -> Sequence[EndLabel]:
    """A line from 0 to `least` or more, logarithmic where it spans decades; it has no name."""
    axes.plot(samples, values, **_LINE | {"marker": _marker(values)} | look)
    low = float(values.min())
    top = max(float(values.max()), least)
    # 20k in place of 20000: a panel is narrow.
    formatter = EngFormatter(sep="") if top >= 1e3 else FormatStrFormatter("%g")
    axes.yaxis.set_major_formatter(formatter)
    if 0 < DECADES * low < top:
        axes.set_yscale("log")
    else:
        # A little below 0, where markers would be cut.
        axes.set_ylim(-0.04 * top, 1.1 * top)
    return ()


def _marker(values: Array) -> str:
    """Marker of the points of a line, none where they are many."""
    return "." if len(values) < POINTS else ""


def _draw_change(axes: Axes, samples: Array, moved: Mapping[str, Array]) -> list[EndLabel]:
    """Norm of the increments of blocks of θ, each (K,)."""
    labels = []
    top = 0.0
    # No more blocks are drawn than there are colours.
    for color, (name, norm) in zip(ENTRIES, moved.items(), strict=False):
        axes.plot(samples, norm, color=color, **_LINE | {"marker": _marker(norm)})
        end = float(norm[-1])
        labels.append(EndLabel(symbol(name), end, color))
        top = max(top, float(norm.max()))
    # Linear below 1, since every increment begins at 0.
    if top > DECADES:
        axes.set_yscale("symlog", linthresh=1.0)
        axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.set_ylim(0.0, 1.05 * top)
    return labels


def parameters_figure(
    samples: Array,
    increments: Mapping[str, Array],
    td_error: Array,
    width: float = WIDTH,
) -> Figure:
    """The paper's figure of a training: increments of θ by block, and the TD error.

    Source: paper.tex, fig. nmpc_learn.

    Args:
        samples: of the training, (K,).
        increments: θ − θ₀ of each block by its name, (K, entries).
        td_error: root mean square over the preceding `TD_WINDOW` samples, (K,).
        width: in inches; a narrow figure has fewer panels beside each other.
    """
    # A rule learns some blocks of θ only.
    moving = {name: values for name, values in increments.items() if np.any(values)}
    columns = PANEL_COLUMNS if width >= NARROW else PANEL_COLUMNS // 2
    rows = -(-len(moving) // columns)
    # The TD error, across the page, is a little higher than the panels of θ.
    heights = [1.0] * rows
    heights.append(1.2)
    with figure(1.3 * rows + 2.2, width) as drawn:
        grid = drawn.add_gridspec(rows + 1, columns, height_ratios=heights)
        first: Axes | None = None
        most_entries = 0
        for i, (name, values) in enumerate(moving.items()):
            row, column = divmod(i, columns)
            axes = drawn.add_subplot(grid[row, column], sharex=first)
            first = first or axes
            _draw_increments(axes, samples, name, values)
            # Samples stand below the lowest panel of each column.
            is_lowest = i + columns >= len(moving)
            axes.tick_params(labelbottom=is_lowest)
            most_entries = max(most_entries, values.shape[1])
        axes = drawn.add_subplot(grid[rows, :], sharex=first)
        axes.plot(samples, td_error, color=INK, linewidth=1.0)
        samples_axis(axes, float(samples[-1]), "samples")
        title = f"TD error in the stage cost's unit, r.m.s. of the preceding {TD_WINDOW} samples"
        _set_title(axes, title, width)
        # A θ that never moved has no entries to name.
        if moving:
            _draw_entries_legend(drawn, most_entries, legend_columns=3 * columns)
        ask(drawn, "How do θ and the TD error change while the rule learns?")
    return drawn


def _draw_increments(axes: Axes, samples: Array, name: str, values: Array) -> None:
    """Draw the increments (K, entries) of a block of θ."""
    # Of a block with more entries than looks the first looks come again.
    for entry, look in zip(values.T, cycle(_ENTRY_LOOKS), strict=False):
        axes.plot(samples, entry, linewidth=0.8, **look)
    axes.set_title(rf"$\Delta$ {symbol(name)}", loc="left", fontsize=PANEL_TITLE_SIZE)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4))


def _draw_entries_legend(drawn: Figure, most_entries: int, legend_columns: int) -> None:
    """Number the looks of a block's entries, as many as the largest block has."""
    handles = []
    for number, look in enumerate(_ENTRY_LOOKS[:most_entries], start=1):
        handles.append(Line2D([], [], linewidth=1.2, label=str(number), **look))
    drawn.legend(
        handles=handles,
        loc="outside lower center",
        ncols=legend_columns,
        title="entry of its block, in the block's own unit",
    )
