"""Figures of a study: regret of each run, learning curves, profiles, blocks, operation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullFormatter

from cosim.figures.style import (
    DASHED,
    FLOOR,
    INK,
    REFERENCE,
    Dots,
    EndLabel,
    Look,
    cost_lines,
    dot_rows,
    figure,
    label_ends,
    palette,
    percent,
    plain,
    regret_axis,
    samples_axis,
)  # fmt: skip
from cosim.protocols import Array
from cosim.statistics import LEVEL, regrets
from cosim.studies.operation import Judged

BANDED = 6
"""Curves of a panel, at most, that have bands: more bands cannot be told apart."""


def regret_figure(rows: Sequence[Dots], looks: Mapping[str, Look]) -> Figure:
    """A row for each case: its runs, their interquartile mean and its 95 % interval.

    A run that diverged is a cross; an interval that goes on to the left of the axes ends in an
    arrow. The least middle is first; the axis is logarithmic above 0.01 %.
    """
    rows = sorted(rows, key=lambda row: row.middle)
    with figure(0.21 * len(rows) + 0.9) as drawn:
        axes = drawn.subplots()
        values = dot_rows(axes, rows, looks)
        regret_axis(axes, "x", np.append(values, [0.0, *(row.high for row in rows)]))
        left = axes.get_xlim()[0]
        cut = [y for y, row in enumerate(rows) if row.low < left]
        axes.plot([left] * len(cut), cut, "<", color=INK, markersize=3, clip_on=False)
        axes.set_xlabel("regret % of runs (crosses diverged); interquartile mean, 95 % interval")
    return drawn


class LearningCurve(NamedTuple):
    """Curves of R runs at K samples: `samples` (K,), `training` and `greedy` (R, K).

    `training` is the mean cost of the training samples since the point before, `greedy` that of
    the policy learnt so far.
    """

    samples: Array
    training: Array
    greedy: Array


def learning_curve(log: pd.DataFrame, best: float | None) -> LearningCurve:
    """The runs of a case at their greedy evaluations, as regret in % where J* is known.

    `log` has rows (training_seed, samples, J, greedy_J). A run that diverged is held at its last
    point.
    """
    runs = []
    for _, rows in log.groupby("training_seed", sort=False):
        # Rows up to a greedy evaluation belong to it.
        point = -rows.greedy_J.notna()[::-1].cumsum()[::-1]
        at = rows[rows.greedy_J.notna()]
        costs = rows.J.groupby(point).mean().iloc[: len(at)]
        runs.append(np.array([at.samples, costs, at.greedy_J], dtype=np.float64))
    longest = max(runs, key=lambda run: run.shape[1])
    count = longest.shape[1]
    held = np.array([np.pad(run, ((0, 0), (0, count - run.shape[1])), mode="edge") for run in runs])
    shown = held[:, 1:] if best is None else 100 * regrets(held[:, 1:], best)
    return LearningCurve(longest[0], shown[:, 0], shown[:, 1])


def curves_figure(
    curves: Mapping[str, LearningCurve],
    levels: Mapping[str, float],
    looks: Mapping[str, Look],
    *,
    relative: bool,
) -> Figure:
    """All cases in two panels: above the cost of the training samples, below the greedy policy's.

    Lines are medians over runs, bands their quartiles, drawn where at most six cases are shown.
    `levels` are drawn across both panels, by name. `relative` values are regrets in %.
    """
    unit = "regret %" if relative else "J"
    height = max(2.6, 0.135 * (len(curves) + len(levels)))
    with figure(2 * height + 0.4) as drawn:
        grid = drawn.subplots(2, 1, sharex=True)
        ends: list[list[EndLabel]] = []
        for axes, kind in zip(grid, ("training", "greedy"), strict=True):
            lines = []
            for name, curve in curves.items():
                values: Array = getattr(curve, kind)
                color, line = looks[name]
                finite = np.isfinite(values).all(axis=0)
                samples, values = curve.samples[finite], values[:, finite]
                if not values.size:
                    continue
                low, middle, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
                style = {"color": color, "linestyle": line, "linewidth": 1.3}
                lines.append((name, samples, middle, style))
                if len(values) > 1 and len(curves) <= BANDED:
                    axes.fill_between(samples, low, high, color=color, alpha=0.15, linewidth=0)
            ends.append(cost_lines(axes, lines, levels, relative=relative))
            axes.set_ylabel(f"{unit} of the {'greedy policy' if ends[1:] else 'training samples'}")
        end = max(float(curve.samples[-1]) for curve in curves.values())
        samples_axis(grid[1], end, "training samples")
        label_ends(drawn, zip(grid, ends, strict=True))
    return drawn


def profile_figure(strata: Mapping[str, Sequence[Array]], looks: Mapping[str, Look]) -> Figure:
    """Performance profiles: the share of runs whose regret is at most so much.

    `strata` are a case's regrets in %, an array for each scenario. The 95 % bands are pointwise,
    a stratified bootstrap over runs; they are drawn where at most six cases are shown.
    """
    finite = np.concatenate([runs[np.isfinite(runs)] for each in strata.values() for runs in each])
    axis = np.geomspace(FLOOR, 1.3 * max(float(finite.max(initial=1.0)), 10 * FLOOR), 200)
    with figure(max(2.6, 0.16 * len(strata) + 0.6)) as drawn:
        axes: Axes = drawn.subplots()
        for name, runs in strata.items():
            color, line = looks[name]
            below = [(stratum[:, None] <= axis).astype(float) for stratum in runs]
            share = np.concatenate(below).mean(axis=0)
            axes.step(axis, share, where="post", c=color, ls=line, lw=1.3, label=plain(name))
            if len(strata) <= BANDED:
                low, high = _band(below)
                axes.fill_between(axis, low, high, step="post", color=color, alpha=0.15, lw=0)
        axes.set_xscale("log")
        axes.set_xlim(axis[0], axis[-1])
        axes.set_ylim(-0.02, 1.02)
        axes.xaxis.set_major_formatter(FuncFormatter(percent))
        axes.set_xlabel("regret % at most")
        axes.set_ylabel("share of runs")
        drawn.legend(loc="outside right upper", handlelength=2.4)
    return drawn


def _band(below: Sequence[Array]) -> tuple[Array, Array]:
    """Pointwise bootstrap interval of the mean over runs, resampled within each stratum."""
    rng = np.random.default_rng(0)
    draws = np.zeros((2000, below[0].shape[1]))
    for part in below:
        draws += rng.multinomial(len(part), np.full(len(part), 1 / len(part)), size=2000) @ part
    draws /= sum(map(len, below))
    low, high = np.quantile(draws, (0.5 - LEVEL / 2, 0.5 + LEVEL / 2), axis=0)
    return low, high


def operation_figure(
    found: Judged, about: Mapping[str, Any], looks: Mapping[str, Look], baselines: Sequence[str]
) -> Figure:
    """Greedy regret and regret so far against the plant's samples, on log axes.

    Lines are medians over the training seeds, bands from the best to the worst; `baselines` are
    dashed and have no bands; `about` may name the cases that are `drawn`. Vertical lines stand at
    an hour, a shift, a day, a week.
    """
    named = {"hour": 1, "shift": 8, "day": 24, "week": 168}
    lives, h = found.lives, about["sampling_time"]
    lives = lives[lives.case.isin(about["drawn"] or lives.case)]
    lines = palette(list(map(str, lives.case.unique())))
    with figure(3.4) as drawn:
        panels = drawn.subplots(1, 2, sharey=True)
        titles = ("of θ, run greedily", "of the run so far, exploration included")
        reached = 100 * lives[["regret", "life_regret"]].to_numpy(dtype=np.float64)
        for axes, name, title in zip(panels, ("regret", "life_regret"), titles, strict=True):
            ends = []
            for case, rows in lives.groupby("case", sort=False):
                runs = 100 * rows.groupby("samples")[name].agg(["min", "median", "max"])
                color, line = looks[str(case)].color, lines[str(case)].line
                known = case in baselines
                dashes, width = (DASHED, 0.9) if known else (line, 1.5)
                axes.plot(runs.index, runs["median"], c=color, ls=dashes, lw=width)
                if not known:
                    band = runs["min"], runs["max"]
                    axes.fill_between(runs.index, *band, color=color, alpha=0.12, lw=0)
                ends.append(EndLabel(plain(str(case)), float(runs["median"].iloc[-1]), color))
            axes.set_xscale("log")
            first, end = float(lives.samples.min()), float(lives.samples.max())
            axes.set_xlim(first, end)
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.xaxis.set_minor_formatter(NullFormatter())
            regret_axis(axes, "y", reached)
            for text, hours in named.items():
                if first <= (samples := hours * 3600.0 / h) <= end:
                    part = np.log(samples / first) / np.log(end / first)
                    side = "left" if part < 0.06 else "right" if part > 0.94 else "center"
                    axes.axvline(samples, color=REFERENCE, linewidth=0.7, linestyle=(0, (1, 2)))
                    axes.annotate(
                        text, (samples, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
                        textcoords="offset points", ha=side, fontsize=6.5, color=REFERENCE,
                    )  # fmt: skip
            axes.set_title(title, pad=12)
            axes.set_xlabel("samples of the plant")
        panels[0].set_ylabel("regret %")
        label_ends(drawn, [(panels[1], ends)])
    return drawn
