"""The paper's figure of a training: increments of θ, and the TD error."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from cosim.figures.style import SERIES, figure, save, symbol

Array = NDArray[np.float64]


def plot_parameters_and_td_error(
    samples: Array,
    increments: Mapping[str, Array],
    td_samples: Array,
    td_error: Array,
    path: str | Path,
    *,
    window: int = 10_000,
) -> Path:
    """Draw the paper's figure: increments of θ by block, and the TD error over a window.

    `increments` maps a block's name to θ − θ₀ (K, entries) at `samples` (K,); `td_error` (M,) at
    `td_samples` (M,) is the root mean square over the preceding `window` samples. Source:
    paper.tex, fig. nmpc_learn.
    """
    moving = {name: np.atleast_2d(values.T).T for name, values in increments.items()}
    moving = {name: values for name, values in moving.items() if np.any(values)}
    columns = 4
    rows = -(-len(moving) // columns)
    end = float(max(td_samples[-1], samples[-1]))
    with figure(1.3 * rows + 2.2) as drawn:
        grid = drawn.add_gridspec(rows + 1, columns, height_ratios=[*[1.0] * rows, 1.2])
        first: Axes | None = None
        for i, (name, values) in enumerate(moving.items()):
            axes = drawn.add_subplot(grid[i // columns, i % columns], sharex=first)
            first = first or axes
            for entry, color in zip(values.T, cycle(SERIES), strict=False):
                axes.plot(samples, entry, color=color, linewidth=0.8)
            axes.set_title(rf"$\Delta$ {symbol(name)}", loc="left", fontsize=8.0)
            axes.tick_params(labelbottom=i + columns >= len(moving))
            axes.set_xlim(0.0, end)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4))
        axes = drawn.add_subplot(grid[rows, :])
        axes.plot(td_samples, td_error, color=SERIES[1], linewidth=1.0)
        axes.set_xlim(0.0, end)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_xlabel("samples")
        title = f"TD error, root mean square of the preceding {window} samples"
        axes.set_title(title, loc="left", fontsize=8.0)
        most = max((values.shape[1] for values in moving.values()), default=0)
        drawn.legend(
            handles=[Line2D([], [], color=color, linewidth=1.2) for color in SERIES[:most]],
            labels=[_ordinals(i, most) for i in range(min(most, len(SERIES)))],
            loc="outside lower center",
            ncols=len(SERIES) + 1,
            title="entry of its block",
        )
    return save(drawn, path)


def _ordinals(color: int, entries: int) -> str:
    """Numbers, from 1, of the entries that have a colour of the cycle."""
    return ", ".join(str(i + 1) for i in range(color, entries, len(SERIES)))
