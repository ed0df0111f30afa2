"""Figures of a study: of its tables, and of the runs and logs that it keeps beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
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
from cosim.core.training_options import LOG, PARAMETERS
from cosim.core.trajectory import Trajectory, read_csv
from cosim.figures import style
from cosim.figures.style import BOUND, DASHED, DotRow, EndLabel, LineStyle, palette, shown_case
from cosim.figures.training import parameters_figure
from cosim.figures.trajectory import overlay_figure, trajectory_figure
from cosim.measurement import built
from cosim.studies.operation import OperationLayout, OperationResult
from cosim.studies.plan import StudyPlan
from cosim.studies.report import FOLDER
from cosim.studies.run import Run, folder_name, read_table

BANDED = 6
"""Largest number of curves with bands in a panel: more cannot be told apart."""
Policy = Callable[[Array], Array]
THETA_PREFIX = "theta "
"""Of the columns of a log that hold θ."""
GRID = 13
"""Points of a phase portrait's arrows in each direction."""
BINS = 80
"""Bins of a density, at most."""


def regret_figure(rows: Sequence[DotRow], styles: Mapping[str, LineStyle]) -> Figure:
    """A row for each case: its runs, their interquartile mean and its 95 % interval.

    A run that diverged is a cross; an interval that goes on to the left of the axes ends in an
    arrow. The least middle is first; the axis is logarithmic above 0.01 %.

    Args:
        rows: regrets of each case, in %.
        styles: line style of each case.
    """
    rows = sorted(rows, key=lambda row: row.middle)
    with style.figure(0.21 * len(rows) + 0.9) as drawn:
        axes = drawn.subplots()
        values = style.dot_rows(axes, rows, styles)
        upper_ends = [row.high for row in rows]
        shown_values = np.append(values, [0.0, *upper_ends])
        style.regret_axis(axes, "x", shown_values)
        # An arrow stands where an interval leaves the axes.
        left = axes.get_xlim()[0]
        cut = [place for place, row in enumerate(rows) if row.low < left]
        left_edge = np.full(len(cut), left)
        axes.plot(left_edge, cut, "<", color=style.INK, markersize=3, clip_on=False)
        axes.set_xlabel("regret % of runs (crosses diverged); interquartile mean, 95 % interval")
    return drawn


@dataclass(frozen=True)
class LearningCurve:
    """R runs of a case at their K greedy evaluations.

    Attributes:
        samples: plant samples of the training, (K,).
        training: mean cost of the training samples since the point before, (R, K).
        greedy: mean cost of the policy learned so far, (R, K).
    """

    samples: Array
    training: Array
    greedy: Array


def learning_curve(log: pd.DataFrame, best: float | None) -> LearningCurve:
    """The learning curve of a case, of which a run that diverged stays at its last point.

    Args:
        log: rows (training_seed, samples, J, greedy_J); greedy_J is NaN between evaluations.
        best: J*; costs are then regrets in %.
    """
    runs = []
    for _, rows in log.groupby("training_seed", sort=False):
        runs.append(_points_of_a_run(rows))
    # A run that diverged has fewer points: those that did not set the axis.
    longest = max(runs, key=lambda points: points.shape[1])
    samples = longest[0]
    n_points = len(samples)
    training = np.array([_padded(points[1], n_points) for points in runs])
    greedy = np.array([_padded(points[2], n_points) for points in runs])
    if best is not None:
        training = 100 * regrets(training, best)
        greedy = 100 * regrets(greedy, best)
    return LearningCurve(samples, training, greedy)


def _points_of_a_run(log: pd.DataFrame) -> Array:
    """Samples, mean training cost and greedy cost at each greedy evaluation of a run, (3, K)."""
    evaluated = log.greedy_J.notna()
    # Rows up to a greedy evaluation belong to it: number them by the evaluations that follow.
    evaluations_left = evaluated[::-1].cumsum()[::-1]
    training = log.J.groupby(-evaluations_left).mean()
    # Rows behind the last evaluation make no point.
    training = training.iloc[: evaluated.sum()]
    points = [log.samples[evaluated], training, log.greedy_J[evaluated]]
    return np.array(points, dtype=np.float64)


def _padded(values: Array, length: int) -> Array:
    """Values followed by the last of them, (length,)."""
    return np.pad(values, (0, length - len(values)), mode="edge")


def curves_figure(
    curves: Mapping[str, LearningCurve],
    levels: Mapping[str, float],
    styles: Mapping[str, LineStyle],
    *,
    relative: bool,
) -> Figure:
    """Above the cost of the training samples, below the greedy policy's.

    More than six cases have a column for each θ that they start from. Lines are medians over runs,
    bands their quartiles, drawn where at most six cases are in a panel.

    Args:
        curves: curve of each case.
        levels: costs that are drawn across all panels, by name.
        styles: line style of each case.
        relative: whether costs are regrets in %.
    """
    unit = "regret %" if relative else "J"
    height = max(2.6, 0.135 * (len(curves) + len(levels)))
    starts = _by_start(curves)
    if len(curves) <= BANDED or not 1 < len(starts) < BANDED:
        starts = {"": list(curves)}
    legend: dict[str, Line2D] = {}
    with style.figure(2 * height + 0.4) as drawn:
        grid = drawn.subplots(2, len(starts), sharex=True, sharey="row", squeeze=False)
        labels: list[tuple[Axes, list[EndLabel]]] = []
        for row, kind in zip(grid, ("training samples", "greedy policy"), strict=True):
            for axes, (start, names) in zip(row, starts.items(), strict=True):
                panel = {name: curves[name] for name in names}
                # Beside other panels a case's line says its rule alone.
                lines = palette(names) if start else styles
                costs = {
                    name: curve.training if kind == "training samples" else curve.greedy
                    for name, curve in panel.items()
                }
                medians = _draw_bands(axes, panel, costs, styles, lines)
                for name, _, _, look in medians:
                    rule = shown_case(name).replace(start.replace("from", ","), "")
                    legend.setdefault(rule, Line2D([], [], label=rule, **look))
                ends = style.cost_lines(axes, medians, levels, relative=relative)
                if axes is row[-1]:
                    # The legend below names the rules of several panels.
                    labels.append((axes, ends[: len(levels)] if start else ends))
                axes.set_title(start if kind == "training samples" else "")
            if relative:
                intervals = [axes.dataLim.intervaly for axes in row]
                style.regret_axis(row[0], "y", np.concatenate(intervals))
            row[0].set_ylabel(f"{unit} of the {kind}")
        end = max(float(curve.samples[-1]) for curve in curves.values())
        for axes in grid[1]:
            style.samples_axis(axes, end, "training samples")
        if len(starts) > 1:
            widest = max(len(rule) for rule in legend)
            columns = max(1, 132 // (widest + 10))  # of characters across the page
            drawn.legend(handles=[*legend.values()], loc="outside lower center", ncols=columns)
        style.label_ends(drawn, labels)
    return drawn


def _draw_bands(
    axes: Axes,
    curves: Mapping[str, LearningCurve],
    costs: Mapping[str, Array],
    styles: Mapping[str, LineStyle],
    lines: Mapping[str, LineStyle],
) -> list[tuple[str, Array, Array, dict[str, Any]]]:
    """Draw quartiles of the costs over the runs; return the medians as `cost_lines` takes them.

    Args:
        axes: where they are drawn.
        curves: curve of each case, for its samples.
        costs: costs (R, K) of each case.
        styles: of which the colours are taken.
        lines: of which the dashes are taken.
    """
    medians = []
    for name, curve in curves.items():
        finite = np.isfinite(costs[name]).all(axis=0)
        samples = curve.samples[finite]
        values = costs[name][:, finite]
        if not values.size:
            continue
        low, middle, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
        color = styles[name].color
        look: dict[str, Any] = {"color": color, "linestyle": lines[name].line, "linewidth": 1.3}
        medians.append((name, samples, middle, look))
        if len(values) > 1 and len(curves) <= BANDED:
            axes.fill_between(samples, low, high, color=color, alpha=0.15, linewidth=0)
    return medians


def _by_start(names: Iterable[str]) -> dict[str, list[str]]:
    """Cases by where θ starts, titled so; those without a start are in the last panel."""
    panels: dict[str, list[str]] = {}
    for name in sorted(names, key=lambda name: "start=" not in name):
        start = name.partition("start=")[2].rstrip(")").split(" ")[0]
        panels.setdefault(f"from {start}" if start else "others", []).append(name)
    return panels


def operation_figure(
    result: OperationResult,
    layout: OperationLayout,
    styles: Mapping[str, LineStyle],
    baselines: Sequence[str],
) -> Figure:
    """Greedy regret and regret of the whole run against the plant's samples, on log axes.

    Lines are medians over the training seeds, bands from the best to the worst. Vertical lines
    stand at an hour, a shift, a day, a week.

    Args:
        result: the regrets of all runs.
        layout: the plant's sampling time, and the cases that are drawn.
        styles: line style of each case.
        baselines: cases with a dashed line and no band.
    """
    runs = result.runs
    if layout.drawn:
        runs = runs[runs.case.isin(layout.drawn)]
    lines = palette([str(case) for case in runs.case.unique()])
    first = float(runs.samples.min())
    last = float(runs.samples.max())
    titles = {
        "regret": "regret % of θ at that time",
        "life_regret": "regret % of all samples so far",
    }
    all_regrets = 100 * runs[list(titles)].to_numpy(dtype=np.float64)
    with style.figure(3.4) as drawn:
        panels = drawn.subplots(1, 2, sharey=True)
        for axes, (name, title) in zip(panels, titles.items(), strict=True):
            labels = []
            for case, rows in runs.groupby("case", sort=False):
                spread = 100 * rows.groupby("samples")[name].agg(["min", "median", "max"])
                color = styles[str(case)].color
                if case in baselines:
                    axes.plot(spread.index, spread["median"], c=color, ls=DASHED, lw=0.9)
                else:
                    line = lines[str(case)].line
                    axes.plot(spread.index, spread["median"], c=color, ls=line, lw=1.5)
                    axes.fill_between(
                        spread.index, spread["min"], spread["max"], color=color, alpha=0.12, lw=0
                    )
                end = float(spread["median"].iloc[-1])
                labels.append(EndLabel(shown_case(str(case)), end, color))
            axes.set_xscale("log")
            axes.set_xlim(first, last)
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.xaxis.set_minor_formatter(NullFormatter())
            style.regret_axis(axes, "y", all_regrets)
            _mark_times(axes, layout.sampling_time, first, last)
            axes.set_title(title, pad=12)
            axes.set_xlabel("samples of the plant")
        style.label_ends(drawn, [(panels[1], labels)])
    return drawn


def _mark_times(axes: Axes, sampling_time: float, first: float, last: float) -> None:
    """Draw a line at an hour, a shift, a day and a week of samples, on a log axis.

    Args:
        axes: where they are drawn.
        sampling_time: of the plant, in s.
        first: least sample of the axis.
        last: largest sample of the axis.
    """
    for name, hours in {"hour": 1, "shift": 8, "day": 24, "week": 168}.items():
        samples = hours * 3600.0 / sampling_time
        if not first <= samples <= last:
            continue
        # Near an edge the name is set inwards.
        share = np.log(samples / first) / np.log(last / first)
        side = "center"
        if share < 0.06:
            side = "left"
        elif share > 0.94:
            side = "right"
        axes.axvline(samples, color=style.REFERENCE, linewidth=0.7, linestyle=(0, (1, 2)))
        axes.annotate(
            name,
            (samples, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2),
            textcoords="offset points",
            ha=side,
            fontsize=6.5,
            color=style.REFERENCE,
        )


def draw_kept(plan: StudyPlan, out: Path, formats: Sequence[str] = style.FORMATS) -> list[str]:
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
    drawn = chain(_trajectory_figures(plan, out), _training_figures(plan, out))
    return style.save_set(drawn, out / FOLDER, formats)


def _trajectory_figures(plan: StudyPlan, out: Path) -> Iterator[tuple[str, Figure]]:
    """Names and figures of the kept trajectories."""
    for name, scenario in plan.definition.scenarios.items():
        for table in plan.definition.table.trajectory:
            runs: dict[str, Run] = {}
            trajectories: dict[str, Trajectory] = {}
            for run in plan.runs:
                kept = run.kept.get(table.file)
                if run.scenario.name != name or kept is None or not (out / kept).is_file():
                    continue
                runs[run.case] = run
                trajectory = read_csv(out / kept, scenario)
                trajectories[run.case] = replace(trajectory, controller=run.case)
            if not trajectories:
                continue
            for kind in table.figures:
                stem = f"{kind}-{folder_name(name)}-{table.name}"
                if kind == "trajectory":
                    beside = list(trajectories.values())
                    for case, trajectory in trajectories.items():
                        drawn = trajectory_figure(trajectory, scenario, beside=beside)
                        yield f"{stem}-{folder_name(case)}", drawn
                elif kind == "overlay":
                    yield stem, overlay_figure(trajectories)
                elif kind == "density":
                    yield stem, density_figure(trajectories, scenario)
                else:
                    policies = {case: _policy(run, out) for case, run in runs.items()}
                    yield stem, phase_figure(trajectories, policies, scenario)


def _training_figures(plan: StudyPlan, out: Path) -> Iterator[tuple[str, Figure]]:
    """Names and figures of the kept logs; a run in operation has none."""
    for run in plan.runs:
        kept = run.kept.get(LOG)
        if run.marks or kept is None or not (out / kept).is_file():
            continue
        log = read_table(out / kept)
        blocks = increments(log)
        # A log without θ has nothing to draw.
        if not blocks:
            continue
        samples = log["samples"].to_numpy(float)
        updates = log["updates"].to_numpy(float)
        td_error = log["td_error"].to_numpy(float)
        windowed_error = td_error_mean(samples, td_error, updates)
        drawn = parameters_figure(samples, blocks, windowed_error)
        yield f"parameters-{Path(kept).stem}", drawn


def increments(log: pd.DataFrame) -> dict[str, Array]:
    """θ less its first row by block, (K, entries), of a training's log of K rows."""
    theta = log.filter(like=THETA_PREFIX).astype(float)
    changes = theta - theta.iloc[0]
    entries: dict[str, list[Array]] = {}
    for column in theta:
        # A column is called `theta BLOCK[i,j]`.
        entry = str(column).removeprefix(THETA_PREFIX)
        block = entry.partition("[")[0]
        values = changes[column].to_numpy()
        entries.setdefault(block, []).append(values)
    return {block: np.column_stack(columns) for block, columns in entries.items()}


def density_figure(runs: Mapping[str, Trajectory], scenario: Scenario) -> Figure:
    """Density of the first state against its lower bound, a line for each controller.

    The bins are common and an edge lies on the bound, so that no bin mixes both sides; the axis
    leaves out the outermost 0.1 % of all samples. The legend gives the share that violates it.

    Args:
        runs: trajectory of each controller.
        scenario: of the plant.
    """
    name = scenario.plant.states[0]
    bound = float(scenario.state_lower[0])
    unit = next(iter(runs.values())).signals[name].unit
    samples = {case: run[name] for case, run in runs.items()}
    edges, width = _common_bins(list(samples.values()), bound)
    styles = palette(list(samples))
    with style.figure(2.9, 4.6) as drawn:
        axes = drawn.subplots()
        for case, values in samples.items():
            violates = bound - values > VIOLATING
            share = 100 * float(np.mean(violates))
            counts = np.histogram(values, edges)[0]
            heights = counts / (len(values) * width)
            color = styles[case].color
            axes.stairs(heights, edges, fill=True, alpha=0.12, color=color)
            text = f"{shown_case(case)}: {share:.1f} % below"
            axes.stairs(heights, edges, color=color, linewidth=1.2, label=text)
        axes.axvline(bound, color=BOUND, linewidth=1.1, linestyle=DASHED, label="bound")
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(style.label(name, unit))
        axes.set_ylabel(_density_label(unit))
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2)
    return drawn


def _density_label(unit: str) -> str:
    """Label of a density over a quantity with a unit."""
    if unit in ("", "1"):
        return "density"
    # Without brackets 1/kg/min would read as a division by both.
    inverse = f"1/({unit})" if "/" in unit else f"1/{unit}"
    return f"density [{inverse}]"


def _common_bins(samples: Sequence[Array], bound: float) -> tuple[Array, float]:
    """Edges of bins for several histograms, of which one is `bound`, and the bins' width."""
    all_samples = np.concatenate(samples)
    low = min(float(np.quantile(all_samples, 0.001)), bound)
    high = max(float(np.quantile(all_samples, 0.999)), bound)
    width = (high - low) / BINS
    # Not narrower than the smallest sample can fill (Freedman and Diaconis' rule).
    for values in samples:
        lower_quartile, upper_quartile = np.quantile(values, (0.25, 0.75))
        spread = upper_quartile - lower_quartile
        width = max(width, float(2 * spread / np.cbrt(len(values))))
    # All samples may be one number.
    if not width:
        width = 1e-3 * max(abs(bound), 1.0)
    # Edges are whole widths from the bound, one bin more than needed on either side.
    below = -np.ceil((bound - low) / width) - 1
    above = np.ceil((high - bound) / width) + 2
    edges: Array = bound + width * np.arange(below, above)
    return edges, width


def phase_figure(
    runs: Mapping[str, Trajectory], policies: Mapping[str, Policy], scenario: Scenario
) -> Figure:
    """Phase portraits, a panel for each controller: where the state lives, and its policy there.

    Background: density of the visited states, logarithmic. Arrows: the policy as a vector field,
    (π(s) − u_s)/(u_u − u_l), right where the first input rises and up where the second does; an
    arrow's length goes with the root of its size. Red: bounds. Cross: operating point.

    Args:
        runs: trajectory of each controller.
        policies: action (m,) of each controller in a state (n,).
        scenario: of the plant, with two states and two inputs.
    """
    visited = np.concatenate([run.states for run in runs.values()])
    low, high = np.quantile(visited, (0.001, 0.999), axis=0)
    x = np.linspace(low[0], high[0], GRID)
    y = np.linspace(low[1], high[1], GRID)
    fields = {case: _field(policy, x, y, scenario) for case, policy in policies.items()}
    # Arrows of all panels have one scale, so that policies can be compared.
    longest = _longest_arrow(list(fields.values()))
    # Policies that stay at the operating point have no arrows to scale.
    arrow_scale = longest or 1.0
    columns = 2 if len(runs) == 4 else min(len(runs), 3)
    rows = -(-len(runs) // columns)
    # The axes reach half a cell beyond the outermost arrows.
    half_x = 0.5 * (x[1] - x[0])
    half_y = 0.5 * (y[1] - y[0])
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    signals = next(iter(runs.values())).signals
    operating_point = scenario.reference_state[:2]
    height = 7.0 / columns * rows + 0.4
    width = style.WIDTH if columns > 1 else 4.2
    with style.figure(height, width) as drawn:
        grid = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(runs) :]:
            axes.set_visible(False)
        for axes, (case, run) in zip(grid.flat, runs.items(), strict=False):
            _draw_density(axes, run.states[:, :2], extent)
            _draw_arrows(axes, x, y, fields[case] / arrow_scale)
            axes.plot(
                operating_point[0],
                operating_point[1],
                "+",
                color=BOUND,
                markersize=9,
                markeredgewidth=1.6,
                zorder=5,
            )
            _draw_bounds(axes, scenario)
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


def _longest_arrow(fields: Sequence[Array]) -> float:
    """Largest length in fields (Y, X, 2); an action that is NaN has none."""
    longest = 0.0
    for field in fields:
        lengths = np.hypot(field[..., 0], field[..., 1])
        longest = max(longest, float(np.nanmax(lengths)))
    return longest


def _draw_bounds(axes: Axes, scenario: Scenario) -> None:
    """Draw the bounds of the first two states, across and upright."""
    look: dict[str, Any] = {"color": BOUND, "linewidth": 1.0, "linestyle": DASHED, "zorder": 3}
    for bounds in (scenario.state_lower, scenario.state_upper):
        axes.axvline(bounds[0], **look)
        axes.axhline(bounds[1], **look)


def _field(policy: Policy, x: Array, y: Array, scenario: Scenario) -> Array:
    """First two inputs of a policy less the operating point, in shares of their range.

    Args:
        policy: of the state, (n,).
        x: first state of the grid, (X,).
        y: second state of the grid, (Y,).
        scenario: of the plant, with two states.

    Returns:
        The field, (Y, X, 2).
    """
    # Inputs of unlike units become comparable as shares of their range.
    input_range = scenario.action_upper - scenario.action_lower
    actions = np.empty((len(y), len(x), 2))
    for row, second in enumerate(y):
        for column, first in enumerate(x):
            state = np.array([first, second])
            actions[row, column] = policy(state)[:2]
    from_operating_point = actions - scenario.reference_action[:2]
    field: Array = from_operating_point / input_range[:2]
    return field


def _draw_arrows(axes: Axes, x: Array, y: Array, field: Array) -> None:
    """Draw a field (Y, X, 2) on a grid as arrows, whose length goes with the root of its size."""
    size = np.hypot(field[..., 0], field[..., 1])
    # Divided by the root of its size: else small arrows could not be seen beside large ones.
    shrink = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
    axes.quiver(
        *np.meshgrid(x, y),
        field[..., 0] * shrink,
        field[..., 1] * shrink,
        angles="uv",
        pivot="mid",
        scale=1.05 * max(len(x), len(y)),
        scale_units="width",
        width=0.004,
        color="#1A1A1A",
        zorder=4,
    )


def _draw_density(axes: Axes, states: Array, extent: tuple[float, float, float, float]) -> None:
    """Draw how often a run of states (K, 2) was where, within left, right, bottom and top."""
    left, right, bottom, top = extent
    x = states[:, 0]
    y = states[:, 1]
    inside = (x > left) & (x < right) & (y > bottom) & (y < top)
    cells = axes.hexbin(
        x[inside],
        y[inside],
        gridsize=40,
        extent=extent,
        mincnt=1,
        linewidths=0.1,
        zorder=1,
    )
    counts = cells.get_array()
    if counts is not None and counts.size:
        # The upper part of the map is left out: arrows must stay legible on it.
        cells.set(cmap="YlGnBu", norm=LogNorm(0.7, 20.0 * float(counts.max())))


def _policy(run: Run, out: Path) -> Policy:
    """Action (m,) of a run's controller in a state (n,); raises StudyError where its θ is gone."""
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
