"""Figures of a study: regret of each run, learning curves, profiles, blocks, operation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
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
    regret_axis,
    samples_axis,
    shown_case,
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
    """Above the cost of the training samples, below the greedy policy's.

    More than six cases have a column for each θ that they start from. Lines are medians over runs,
    bands their quartiles, drawn where at most six cases are in a panel. `levels` are drawn across
    all panels, by name. `relative` values are regrets in %.
    """
    unit = "regret %" if relative else "J"
    words = {"training": "training samples", "greedy": "greedy policy"}
    height = max(2.6, 0.135 * (len(curves) + len(levels)))
    starts = _by_start(curves) if len(curves) > BANDED else {"": list(curves)}
    handles: dict[str, Line2D] = {}
    with figure(2 * height + 0.4) as drawn:
        grid = drawn.subplots(2, len(starts), sharex=True, sharey="row", squeeze=False)
        named: list[tuple[Axes, list[EndLabel]]] = []
        for row, kind in zip(grid, words, strict=True):
            for axes, (start, names) in zip(row, starts.items(), strict=True):
                lines, own = [], palette(names)
                for name in names:
                    curve, values = curves[name], getattr(curves[name], kind)
                    finite = np.isfinite(values).all(axis=0)
                    samples, values = curve.samples[finite], values[:, finite]
                    if not values.size:
                        continue
                    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
                    color, line = looks[name].color, (own if start else looks)[name].line
                    style: Any = {"color": color, "linestyle": line, "linewidth": 1.3}
                    lines.append((name, samples, middle, style))
                    rule = shown_case(name).replace(start.replace("from", ","), "")
                    handles.setdefault(rule, Line2D([], [], label=rule, **style))
                    if len(values) > 1 and len(names) <= BANDED:
                        axes.fill_between(samples, low, high, color=color, alpha=0.15, linewidth=0)
                ends = cost_lines(axes, lines, levels, relative=relative)
                if axes is row[-1] or len(starts) == 1:
                    named.append((axes, ends[: len(levels)] if start else ends))
                if start and kind == "training":
                    axes.set_title(start)
            if relative:
                regret_axis(row[0], "y", np.concatenate([axes.dataLim.intervaly for axes in row]))
            row[0].set_ylabel(f"{unit} of the {words[kind]}")
        end = max(float(curve.samples[-1]) for curve in curves.values())
        for axes in grid[1]:
            samples_axis(axes, end, "training samples")
        if len(starts) > 1:
            drawn.legend(handles=[*handles.values()], loc="outside lower center", ncols=4)
        label_ends(drawn, named)
    return drawn


def _by_start(names: Iterable[str]) -> dict[str, list[str]]:
    """Cases by where θ starts, titled so; those without a start are in the last panel."""
    panels: dict[str, list[str]] = {}
    for name in sorted(names, key=lambda name: "start=" not in name):
        start = name.partition("start=")[2].rstrip(")").split(" ")[0]
        panels.setdefault(f"from {start}" if start else "others", []).append(name)
    return panels


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
            axes.step(axis, share, where="post", c=color, ls=line, lw=1.3, label=shown_case(name))
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
        titles = ("regret % of θ at that time", "regret % of all samples so far")
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
                ends.append(EndLabel(shown_case(str(case)), float(runs["median"].iloc[-1]), color))
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
        label_ends(drawn, [(panels[1], ends)])
    return drawn
