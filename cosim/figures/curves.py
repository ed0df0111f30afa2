"""Learning curves: cost of the training samples, and of the greedy policy, over samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from cosim.figures.style import (
    REFERENCE,
    SERIES,
    WIDTH,
    EndLabel,
    cost_axis,
    figure,
    label_ends,
    plain,
    save,
)

Array = NDArray[np.float64]
CURVES = 4
"""Curves of a panel, at most: more cannot be told apart."""


@dataclass(frozen=True)
class LearningCurve:
    """Curves of R runs at K samples: `samples` (K,), `training` and `greedy` (R, K), NaN gaps.

    `training` is the cost of the training samples themselves since the last point, `greedy` that
    of the policy learnt so far.
    """

    samples: Array
    training: Array
    greedy: Array

    @property
    def both(self) -> tuple[Array, Array]:
        """Training and greedy."""
        return self.training, self.greedy


Panels = Mapping[str, Mapping[str, LearningCurve]]


def plot_curves(
    panels: Panels,
    levels: Mapping[str, float],
    path: str | Path,
    *,
    ylabel: str,
    relative: bool,
) -> Path:
    """Draw a column for each panel: above what training cost, below the greedy policy.

    Lines are medians over runs, bands their quartiles. `levels` are drawn across all panels, by
    name. The ordinate is `cost_axis`.
    Raises FigureError as `save` does.
    """
    columns = len(panels)
    everything = [quartiles(v) for p in panels.values() for c in p.values() for v in c.both]
    reached = np.concatenate([np.ravel(middle) for middle, *_ in everything])
    shown = np.concatenate([reached[np.isfinite(reached)], list(levels.values())])
    with figure(4.6, max(WIDTH * columns / 2, 4.6)) as drawn:
        grid = drawn.subplots(2, columns, sharex="col", sharey="row", squeeze=False)
        for row, axes_row in enumerate(grid):
            for axes, (title, curves) in zip(axes_row, panels.items(), strict=True):
                _panel(axes, curves, "training" if row == 0 else "greedy")
                cost_axis(axes, shown, relative=relative)
                axes.xaxis.set_major_formatter(EngFormatter(sep=""))
                axes.set_xlim(0.0, max(float(c.samples[-1]) for c in curves.values()))
                if row == 0:
                    axes.set_title(plain(title), loc="left")
                else:
                    axes.set_xlabel("training samples")
        grid[0, 0].set_ylabel(f"{ylabel} of the training samples")
        grid[1, 0].set_ylabel(f"{ylabel} of the greedy policy")
        for axes_row in grid:
            for axes in axes_row:
                for level in levels.values():
                    axes.axhline(level, color=REFERENCE, linewidth=0.8, linestyle=(0, (4, 2)))
        drawn.draw_without_rendering()
        for row, axes_row in enumerate(grid):
            for axes, curves in zip(axes_row, panels.values(), strict=True):
                kind = "training" if row == 0 else "greedy"
                label_ends(axes, [*_ends(curves, kind), *_levels(levels)])
    return save(drawn, path)


def _panel(axes: Axes, curves: Mapping[str, LearningCurve], kind: str) -> None:
    for color, curve in zip(SERIES, curves.values(), strict=False):
        values: Array = getattr(curve, kind)
        known = ~np.isnan(values).all(axis=0)
        samples, values = curve.samples[known], values[:, known]
        middle, low, high = quartiles(values)
        axes.plot(samples, middle, color=color, linewidth=1.3)
        if len(values) > 1:
            axes.fill_between(samples, low, high, color=color, alpha=0.2, linewidth=0)


def quartiles(values: Array) -> tuple[Array, Array, Array]:
    """Median, lower and upper quartile over runs, (K,) each, of values (R, K) with NaN gaps."""
    known = ~np.isnan(values).all(axis=0)
    found = np.full((3, values.shape[1]), np.nan)
    found[:, known] = np.nanquantile(values[:, known], (0.5, 0.25, 0.75), axis=0)
    middle, low, high = found
    return middle, low, high


def _ends(curves: Mapping[str, LearningCurve], kind: str) -> list[EndLabel]:
    found = []
    for color, (name, curve) in zip(SERIES, curves.items(), strict=False):
        values: Array = getattr(curve, kind)
        known = ~np.isnan(values).all(axis=0)
        if known.any():
            found.append(EndLabel(plain(name), float(np.nanmedian(values[:, known][:, -1])), color))
    return found


def _levels(levels: Mapping[str, float]) -> list[EndLabel]:
    return [EndLabel(plain(name), level, REFERENCE) for name, level in levels.items()]


def chunks(names: Sequence[str]) -> list[list[str]]:
    """Names in panels of at most `CURVES`."""
    return [list(names[i : i + CURVES]) for i in range(0, len(names), CURVES)]
