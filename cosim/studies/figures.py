"""Figures of a study: of its tables, and of the runs and logs that it keeps beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from cosim.core.errors import StudyError
from cosim.core.protocols import Array
from cosim.core.scenario import VIOLATING, Scenario
from cosim.core.statistics import regrets, td_error_mean
from cosim.core.trajectory import Trajectory, read_csv
from cosim.figures import style
from cosim.figures.style import BOUND, DASHED, DotRow, EndLabel, LineStyle, palette, shown_case
from cosim.figures.training import parameters_figure
from cosim.figures.trajectory import overlay_figure, trajectory_figure
from cosim.measurement import built
from cosim.studies.operation import Judged
from cosim.studies.plan import Plan
from cosim.studies.report import FOLDER
from cosim.studies.run import LOG, PARAMETERS, Run, read_table, safe

BANDED = 6
"""Largest number of curves with bands in a panel: more cannot be told apart."""
Policy = Callable[[Array], Array]
PREFIX = "theta "
GRID, BINS = 13, 80


def regret_figure(rows: Sequence[DotRow], styles: Mapping[str, LineStyle]) -> Figure:
    """A row for each case: its runs, their interquartile mean and its 95 % interval.

    A run that diverged is a cross; an interval that goes on to the left of the axes ends in an
    arrow. The least middle is first; the axis is logarithmic above 0.01 %.
    """
    rows = sorted(rows, key=lambda row: row.middle)
    with style.figure(0.21 * len(rows) + 0.9) as drawn:
        axes = drawn.subplots()
        values = style.dot_rows(axes, rows, styles)
        style.regret_axis(axes, "x", np.append(values, [0.0, *(row.high for row in rows)]))
        left = axes.get_xlim()[0]
        cut = [y for y, row in enumerate(rows) if row.low < left]
        axes.plot([left] * len(cut), cut, "<", color=style.INK, markersize=3, clip_on=False)
        axes.set_xlabel("regret % of runs (crosses diverged); interquartile mean, 95 % interval")
    return drawn


def learning_curve(log: pd.DataFrame, best: float | None) -> dict[str, Array]:
    """R runs of a case at their K greedy evaluations, as regret in % where J* is known.

    `samples` (K,); `training` (R, K), the mean cost of the training samples since the point before;
    `greedy` (R, K), that of the policy learnt so far. `log` has rows (training_seed, samples, J,
    greedy_J). A run that diverged is held at its last point.
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
    return {"samples": longest[0], "training": shown[:, 0], "greedy": shown[:, 1]}


def curves_figure(
    curves: Mapping[str, Mapping[str, Array]],
    levels: Mapping[str, float],
    styles: Mapping[str, LineStyle],
    *,
    relative: bool,
) -> Figure:
    """Above the cost of the training samples, below the greedy policy's.

    More than six cases have a column for each θ that they start from. Lines are medians over runs,
    bands their quartiles, drawn where at most six cases are in a panel. `levels` are drawn across
    all panels, by name. `relative` values are regrets in %.
    """
    unit = "regret %" if relative else "J"
    height = max(2.6, 0.135 * (len(curves) + len(levels)))
    starts = _by_start(curves)
    if len(curves) <= BANDED or not 1 < len(starts) < BANDED:
        starts = {"": list(curves)}
    handles: dict[str, Line2D] = {}
    with style.figure(2 * height + 0.4) as drawn:
        grid = drawn.subplots(2, len(starts), sharex=True, sharey="row", squeeze=False)
        named: list[tuple[Axes, list[EndLabel]]] = []
        for row, kind in zip(grid, ("training samples", "greedy policy"), strict=True):
            for axes, (start, names) in zip(row, starts.items(), strict=True):
                lines, own = [], palette(names)
                for name in names:
                    curve, values = curves[name], curves[name][kind.split()[0]]
                    finite = np.isfinite(values).all(axis=0)
                    samples, values = curve["samples"][finite], values[:, finite]
                    if not values.size:
                        continue
                    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
                    color, line = styles[name].color, (own if start else styles)[name].line
                    look: Any = {"color": color, "linestyle": line, "linewidth": 1.3}
                    lines.append((name, samples, middle, look))
                    rule = shown_case(name).replace(start.replace("from", ","), "")
                    handles.setdefault(rule, Line2D([], [], label=rule, **look))
                    if len(values) > 1 and len(names) <= BANDED:
                        axes.fill_between(samples, low, high, color=color, alpha=0.15, linewidth=0)
                ends = style.cost_lines(axes, lines, levels, relative=relative)
                if axes is row[-1]:
                    named.append((axes, ends[: len(levels)] if start else ends))
                axes.set_title(start if kind.startswith("training") else "")
            if relative:
                style.regret_axis(
                    row[0], "y", np.concatenate([axes.dataLim.intervaly for axes in row])
                )
            row[0].set_ylabel(f"{unit} of the {kind}")
        end = max(float(curve["samples"][-1]) for curve in curves.values())
        for axes in grid[1]:
            style.samples_axis(axes, end, "training samples")
        if len(starts) > 1:
            columns = max(1, 132 // (max(map(len, handles)) + 10))  # of characters across the page
            drawn.legend(handles=[*handles.values()], loc="outside lower center", ncols=columns)
        style.label_ends(drawn, named)
    return drawn


def _by_start(names: Iterable[str]) -> dict[str, list[str]]:
    """Cases by where θ starts, titled so; those without a start are in the last panel."""
    panels: dict[str, list[str]] = {}
    for name in sorted(names, key=lambda name: "start=" not in name):
        start = name.partition("start=")[2].rstrip(")").split(" ")[0]
        panels.setdefault(f"from {start}" if start else "others", []).append(name)
    return panels


def operation_figure(
    found: Judged,
    about: Mapping[str, Any],
    styles: Mapping[str, LineStyle],
    baselines: Sequence[str],
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
    with style.figure(3.4) as drawn:
        panels = drawn.subplots(1, 2, sharey=True)
        titles = ("regret % of θ at that time", "regret % of all samples so far")
        reached = 100 * lives[["regret", "life_regret"]].to_numpy(dtype=np.float64)
        for axes, name, title in zip(panels, ("regret", "life_regret"), titles, strict=True):
            ends = []
            for case, rows in lives.groupby("case", sort=False):
                runs = 100 * rows.groupby("samples")[name].agg(["min", "median", "max"])
                color, line = styles[str(case)].color, lines[str(case)].line
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
            style.regret_axis(axes, "y", reached)
            for text, hours in named.items():
                if first <= (samples := hours * 3600.0 / h) <= end:
                    part = np.log(samples / first) / np.log(end / first)
                    side = "left" if part < 0.06 else "right" if part > 0.94 else "center"
                    axes.axvline(
                        samples, color=style.REFERENCE, linewidth=0.7, linestyle=(0, (1, 2))
                    )
                    axes.annotate(
                        text, (samples, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
                        textcoords="offset points", ha=side, fontsize=6.5, color=style.REFERENCE,
                    )  # fmt: skip
            axes.set_title(title, pad=12)
            axes.set_xlabel("samples of the plant")
        style.label_ends(drawn, [(panels[1], ends)])
    return drawn


def draw(plan: Plan, out: Path, formats: Sequence[str] = style.FORMATS) -> list[str]:
    """Draw the trajectories and logs that a study keeps.

    Args:
        plan: the study's plan, which names the kept files.
        out: the study's folder, or its stored one; the figures are written to `out`/figures.
        formats: of the files, as in `save_set`.

    Returns:
        Names of the figures.

    Raises:
        StudyError: if a phase portrait needs θ of a training that `out` does not hold.
    """
    return style.save_set(_figures(plan, out), out / FOLDER, formats)


def _figures(plan: Plan, out: Path) -> Iterator[tuple[str, Figure]]:
    for name, scenario in plan.definition.scenarios.items():
        for table in plan.definition.table.trajectory:
            runs = {
                run.case: run
                for run in plan.runs
                if run.scenario.name == name and (out / run.kept.get(table.file, "?")).is_file()
            }
            found = {
                case: replace(read_csv(out / run.kept[table.file], scenario), controller=case)
                for case, run in runs.items()
            }
            for kind in table.figures if found else ():
                stem = f"{kind}-{safe(name)}-{table.name}"
                if kind == "trajectory":
                    for case, one in found.items():
                        drawn = trajectory_figure(one, scenario, beside=[*found.values()])
                        yield f"{stem}-{safe(case)}", drawn
                elif kind == "overlay":
                    yield stem, overlay_figure(found)
                elif kind == "density":
                    yield stem, density_figure(found, scenario)
                else:
                    policies = {case: _policy(run, out) for case, run in runs.items()}
                    yield stem, phase_figure(found, policies, scenario)
    for path in (out / run.kept.get(LOG, "?") for run in plan.runs if not run.marks):
        if path.is_file() and (blocks := increments(log := read_table(path))):
            columns = (log[name].to_numpy(float) for name in ("samples", "td_error", "updates"))
            samples, td_error, updates = columns
            error = td_error_mean(samples, td_error, updates)
            yield f"parameters-{path.stem}", parameters_figure(samples, blocks, error)


def increments(log: pd.DataFrame) -> dict[str, Array]:
    """θ less its first row by block, (K, entries), of a training's log."""
    theta = log.filter(like=PREFIX).astype(float)
    moved = (theta - theta.iloc[0]).T
    blocks = [str(name).removeprefix(PREFIX).partition("[")[0] for name in theta]
    return {str(block): own.to_numpy().T for block, own in moved.groupby(blocks, sort=False)}


def density_figure(runs: Mapping[str, Trajectory], scenario: Scenario) -> Figure:
    """Density of the first state against its lower bound, a line for each controller.

    The bins are common and an edge lies on the bound, so that no bin mixes both sides; the axis
    leaves out the outermost 0.1 % of all samples. The legend gives the share that violates it.
    """
    name, bound = scenario.plant.states[0], float(scenario.state_lower[0])
    unit = next(iter(runs.values())).signals[name].unit
    samples = {case: run[name] for case, run in runs.items()}
    low, high = np.quantile(np.concatenate([*samples.values()]), (0.001, 0.999))
    low, high = min(float(low), bound), max(float(high), bound)
    # Not narrower than the smallest sample can fill (Freedman and Diaconis' rule).
    spans = [
        float(2 * np.subtract(*np.quantile(values, (0.75, 0.25))) / np.cbrt(len(values)))
        for values in samples.values()
    ]
    width = max((high - low) / BINS, *spans) or 1e-3 * max(abs(bound), 1.0)
    edges = bound + width * np.arange(
        -np.ceil((bound - low) / width) - 1, np.ceil((high - bound) / width) + 2
    )
    styles = palette(list(samples))
    with style.figure(2.9, 4.6) as drawn:
        axes = drawn.subplots()
        for case, values in samples.items():
            share = 100 * float(np.mean(bound - values > VIOLATING))
            heights = np.histogram(values, edges)[0] / (len(values) * width)
            color = styles[case].color
            axes.stairs(heights, edges, fill=True, alpha=0.12, color=color)
            text = f"{shown_case(case)}: {share:.1f} % below"
            axes.stairs(heights, edges, color=color, linewidth=1.2, label=text)
        axes.axvline(bound, color=BOUND, linewidth=1.1, linestyle=DASHED, label="bound")
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(style.label(name, unit))
        inverse = f"1/({unit})" if "/" in unit else f"1/{unit}"
        axes.set_ylabel("density" if unit in ("", "1") else f"density [{inverse}]")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2)
    return drawn


def phase_figure(
    runs: Mapping[str, Trajectory], policies: Mapping[str, Policy], scenario: Scenario
) -> Figure:
    """Phase portraits, a panel for each controller: where the state lives, and its policy there.

    Background: density of the visited states, logarithmic. Arrows: the policy as a vector field,
    (π(s) − u_s)/(u_u − u_l), right where the first input rises and up where the second does; an
    arrow's length goes with the root of its size. Red: bounds. Cross: operating point.
    """
    visited = np.concatenate([run.states for run in runs.values()])
    low, high = np.quantile(visited, (0.001, 0.999), axis=0)
    x, y = (np.linspace(low[i], high[i], GRID) for i in range(2))
    width = (scenario.action_upper - scenario.action_lower)[:2]
    fields = {
        case: np.array([[policy(np.array([xj, yi]))[:2] for xj in x] for yi in y])
        for case, policy in policies.items()
    }
    fields = {c: (field - scenario.reference_action[:2]) / width for c, field in fields.items()}
    longest = max(float(np.nanmax(np.hypot(f[..., 0], f[..., 1]))) for f in fields.values())
    columns = 2 if len(runs) == 4 else min(len(runs), 3)
    rows = -(-len(runs) // columns)
    half = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    extent = (x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1])
    signals = next(iter(runs.values())).signals
    with style.figure(7.0 / columns * rows + 0.4, style.WIDTH if columns > 1 else 4.2) as drawn:
        grid = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(runs) :]:
            axes.set_visible(False)
        for axes, (case, run) in zip(grid.flat, runs.items(), strict=False):
            _states(axes, run.states[:, :2], extent)
            _arrows(axes, x, y, fields[case] / (longest or 1.0))
            axes.plot(*scenario.reference_state[:2], "+", color=BOUND, ms=9, mew=1.6, zorder=5)
            for line, i in ((axes.axvline, 0), (axes.axhline, 1)):
                for bound in (scenario.state_lower[i], scenario.state_upper[i]):
                    line(bound, color=BOUND, linewidth=1.0, linestyle=DASHED, zorder=3)
            axes.set_title(shown_case(case))
            axes.set_xlim(extent[:2])
            axes.set_ylim(extent[2:])
        states = [style.label(name, signals[name].unit) for name in scenario.plant.states[:2]]
        for axes in grid[-1]:
            axes.set_xlabel(states[0])
        for axes in grid[:, 0]:
            axes.set_ylabel(states[1])
        first, second = (style.label(name, "") for name in scenario.plant.actions[:2])
        drawn.supxlabel(
            f"arrows: input less its operating point, right {first}, up {second}; the longest is "
            f"{100 * longest:.0f} % of the input range\ncolour: how often the state was there, "
            "logarithmic; red: bounds; cross: operating point",
            fontsize=7.0,
        )
    return drawn


def _arrows(axes: Axes, x: Array, y: Array, field: Array) -> None:
    size = np.hypot(field[..., 0], field[..., 1])
    shrink = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
    axes.quiver(
        *np.meshgrid(x, y), field[..., 0] * shrink, field[..., 1] * shrink, angles="uv",
        pivot="mid", scale=1.05 * max(len(x), len(y)), scale_units="width", width=0.004,
        color="#1A1A1A", zorder=4,
    )  # fmt: skip


def _states(axes: Axes, states: Array, extent: tuple[float, float, float, float]) -> None:
    left, right, bottom, top = extent
    inside = (states > (left, bottom)).all(axis=1) & (states < (right, top)).all(axis=1)
    cells = axes.hexbin(
        *states[inside].T, gridsize=40, extent=extent, mincnt=1, linewidths=0.1, zorder=1
    )
    counts = cells.get_array()
    if counts is not None and counts.size:
        # The upper part of the map is left out: arrows must stay legible on it.
        cells.set(cmap="YlGnBu", norm=LogNorm(0.7, 20.0 * float(counts.max())))


def _policy(run: Run, out: Path) -> Policy:
    theta = ""
    if run.training is not None:
        path = out / run.folder / PARAMETERS
        if not path.is_file():
            raise StudyError(
                f"the phase portrait of '{run.case}' needs its θ, and there is no '{path}'; "
                "run the study again"
            )
        theta = path.read_text("utf-8")
    controller = built(run.source(theta), run.scenario)

    def act(s: Array) -> Array:
        controller.reset()
        # One QP from a cold guess is not the policy: let a real-time iteration settle.
        for _ in range(5):
            controller.prepare()
            action = controller.feedback(s).action
        return action

    return act
