"""Regret of controllers and learnt policies: every run, and the share of runs that is as good."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from cosim.figures.style import FLOOR, SERIES, WIDTH, figure, percent, plain, regret_axis, save

Array = NDArray[np.float64]
FINE = FLOOR


@dataclass(frozen=True)
class Dots:
    """Runs of a case: regrets in % (R,), whether each finished, and an interval in %.

    The interval is that of the interquartile mean over runs, or over noise for a single one.
    """

    group: str
    values: Array
    finished: NDArray[np.bool_]
    middle: float
    interval: tuple[float, float] | None


def plot_regret(cases: Mapping[str, Dots], path: str | Path) -> Path:
    """Draw a row for each case: its runs, their interquartile mean and its 95 % interval.

    A run that diverged is a cross; the axis is logarithmic above `FINE`. Raises FigureError.
    """
    groups = list(dict.fromkeys(dots.group for dots in cases.values()))
    color = {group: SERIES[i % len(SERIES)] for i, group in enumerate(groups)}
    with figure(0.21 * len(cases) + 0.9, WIDTH) as drawn:
        axes = drawn.subplots()
        for row, dots in enumerate(cases.values()):
            own = color[dots.group]
            y = np.full(len(dots.values), row) + _jitter(len(dots.values))
            for marker, chosen in (("o", dots.finished), ("x", ~dots.finished)):
                axes.scatter(
                    dots.values[chosen], y[chosen], marker=marker, s=13, color=own, alpha=0.55,
                    linewidths=0 if marker == "o" else 0.9, zorder=3,
                )  # fmt: skip
            if dots.interval is not None:
                axes.hlines(row, *dots.interval, color="#222222", linewidth=1.1, zorder=4)
            axes.vlines(dots.middle, row - 0.3, row + 0.3, color="#222222", linewidth=1.4, zorder=5)
        axes.set_yticks(range(len(cases)), [plain(name) for name in cases])
        axes.set_ylim(len(cases) - 0.4, -0.6)
        axes.grid(axis="y", visible=False)
        finite = np.concatenate([d.values[np.isfinite(d.values)] for d in cases.values()])
        regret_axis(axes, "x", np.append(finite, 0.0), FINE)
        axes.set_xlabel("regret % of runs (crosses diverged); interquartile mean, 95 % interval")
    return save(drawn, path)


def _jitter(count: int) -> Array:
    """Dots of a row are spread a little, the same way each time."""
    return np.linspace(-0.18, 0.18, count) if count > 1 else np.zeros(count)


@dataclass(frozen=True)
class Profile:
    """Share of runs with at most a regret: `share` with a band, (K,) each, at regrets (K,) in %."""

    regret: Array
    share: Array
    low: Array
    high: Array


def plot_profiles(panels: Mapping[str, Mapping[str, Profile]], path: str | Path) -> Path:
    """Draw performance profiles, a panel for each group; bands are of 95 %. Raises FigureError."""
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    with figure(1.9 * rows + 0.3, max(WIDTH * columns / 3, 4.6)) as drawn:
        grid = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for axes, (title, profiles) in zip(grid, panels.items(), strict=False):
            for color, profile in zip(SERIES, profiles.values(), strict=False):
                axes.step(profile.regret, profile.share, where="post", color=color, linewidth=1.3)
                axes.fill_between(
                    profile.regret, profile.low, profile.high, step="post", color=color, alpha=0.15,
                    linewidth=0,
                )  # fmt: skip
            axes.set_title(plain(title), loc="left")
            axes.set_xscale("log")
            axes.set_xlim(profile.regret[0], profile.regret[-1])
            axes.set_ylim(-0.02, 1.02)
            axes.xaxis.set_major_formatter(FuncFormatter(percent))
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        for row in range(rows):
            grid[row * columns].set_ylabel("share of runs")
        for axes in grid[max(len(panels) - columns, 0) : len(panels)]:
            axes.set_xlabel("regret % at most")
            axes.tick_params(labelbottom=True)
        for axes, profiles in zip(grid, panels.values(), strict=False):
            _name(axes, profiles)
    return save(drawn, path)


def _name(axes: Axes, profiles: Mapping[str, Profile]) -> None:
    """Names in their curves' colours, in the emptier of the two corners that curves leave free."""
    shares = np.array([profile.share for profile in profiles.values()])
    half = shares.shape[1] // 2
    low = shares[:, half:].min() >= 1.0 - shares[:, :half].max()
    for row, (color, name) in enumerate(zip(SERIES, profiles, strict=False)):
        y = 0.03 + 0.1 * (len(profiles) - 1 - row) if low else 0.97 - 0.1 * row
        axes.text(
            0.98 if low else 0.03, y, plain(name), color=color, fontsize=6.5,
            ha="right" if low else "left", va="bottom" if low else "top",
            transform=axes.transAxes, zorder=6,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )  # fmt: skip
