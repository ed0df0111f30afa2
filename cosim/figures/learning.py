"""Learning over samples: curves with bands over seeds, and the paper's figure."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from cosim.figures.style import SERIES, colors, figure, plain, save

Array = NDArray[np.float64]


def plot_learning_curves(
    curves: Mapping[str, tuple[Array, Array]],
    path: str | Path,
    *,
    ylabel: str = "J per sample",
    references: Mapping[str, float] | None = None,
    logarithmic: bool = False,
) -> Path:
    """Draw curves (samples (K,), values (S, K)) of S seeds: median, quartiles, and full range.

    `references` are levels drawn as dashed lines, e.g. the baselines and the optimum.
    """
    with figure(2.8, 4.9) as drawn:
        axes = drawn.subplots()
        color = colors(list(curves))
        for name, (samples, values) in curves.items():
            _band(axes, samples, np.atleast_2d(values), color[name], plain(name))
        levels = references or {}
        for name, level in levels.items():
            axes.axhline(level, color=colors([name])[name], linewidth=0.9, linestyle=(0, (4, 2)))
            axes.annotate(
                f"{plain(name)} {level:.0f}",
                (1.01, level),
                xycoords=("axes fraction", "data"),
                va="center",
                fontsize=6.5,
                color=colors([name])[name],
            )
        if logarithmic:
            axes.set_yscale("log")
        axes.set_xlim(left=0.0)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_xlabel("samples")
        axes.set_ylabel(ylabel)
        axes.legend(loc="best")
    return save(drawn, path)


def _band(axes: Axes, samples: Array, values: Array, color: str, name: str) -> None:
    seeds = len(values)
    axes.plot(
        samples,
        np.nanmedian(values, axis=0),
        color=color,
        linewidth=1.3,
        label=f"{name} ({seeds} seeds)" if seeds > 1 else name,
    )
    if seeds > 1:
        for low, high, alpha in ((0.0, 1.0, 0.12), (0.25, 0.75, 0.25)):
            edges = np.nanquantile(values, (low, high), axis=0)
            axes.fill_between(samples, *edges, color=color, alpha=alpha, linewidth=0)


def plot_parameters_and_td_error(
    samples: Array,
    increments: Mapping[str, Array],
    td_samples: Array,
    td_mean: Array,
    path: str | Path,
    *,
    window: int = 10_000,
) -> Path:
    """Draw the paper's figure: increments of θ by block, and the TD error's running mean.

    `increments` maps a block's name to θ − θ₀ (K, entries) at `samples` (K,); `td_mean` (M,) at
    `td_samples` (M,) is the mean over the preceding `window` samples. Source: paper.tex,
    fig. nmpc_learn.
    """
    moving = {name: np.atleast_2d(values.T).T for name, values in increments.items()}
    moving = {name: values for name, values in moving.items() if np.any(values)}
    columns = 3
    rows = -(-len(moving) // columns)
    end = float(max(td_samples[-1], samples[-1]))
    with figure(1.3 * rows + 1.8) as drawn:
        grid = drawn.add_gridspec(rows + 1, columns, height_ratios=[*[1.0] * rows, 1.2])
        first: Axes | None = None
        for i, (name, values) in enumerate(moving.items()):
            axes = drawn.add_subplot(grid[i // columns, i % columns], sharex=first)
            first = first or axes
            for entry, color in zip(values.T, cycle(SERIES), strict=False):
                axes.plot(samples, entry, color=color, linewidth=0.8)
            axes.set_title(rf"$\Delta$ {_symbol(name)}", loc="left", fontsize=8.0)
            axes.tick_params(labelbottom=i + columns >= len(moving))
            axes.set_xlim(0.0, end)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4))
        axes = drawn.add_subplot(grid[rows, :])
        axes.plot(td_samples, td_mean, color=SERIES[1], linewidth=1.0)
        axes.set_xlim(0.0, end)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_xlabel("samples")
        axes.set_title(f"TD error, mean of the preceding {window} samples", loc="left", fontsize=8)
    return save(drawn, path)


def _symbol(name: str) -> str:
    """`B_Vf` as mathematics, B with the block's subscript."""
    head, _, subscript = name.partition("_")
    if not head.isalpha() or "$" in name:
        return plain(name)
    known = {"lambda": r"\lambda", "sigma": r"\sigma", "Vf": r"V^\mathrm{f}"}
    # The stage cost's blocks are set with ℓ; x_l is the lower bound.
    if head in ("B", "b"):
        known["l"] = r"\ell"
    return f"${head}_{{{known.get(subscript, subscript)}}}$" if subscript else f"${head}$"
