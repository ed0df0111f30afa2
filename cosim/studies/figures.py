"""Figures of a study's tables: regrets of the runs, learning curves, regret in operation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from cosim.core.protocols import Array
from cosim.core.statistics import regrets
from cosim.figures import style
from cosim.figures.style import DASHED, WIDTH, DotRow, EndLabel, LineStyle, palette, shown_case
from cosim.studies.measurements import StudyMeasurements
from cosim.studies.operation_result import OperationResult
from cosim.studies.operation_tables import OperationLayout
from cosim.studies.tables import RUN_KEYS

BANDED = 6
"""Largest number of curves with bands in a panel: more cannot be told apart."""
MOST_LEVELS = 4
"""Baselines that are lines in a figure of curves, at most."""
MARKER_DISTANCE = 0.2
"""Distance of two markers of a curve, as a share of its panel's diagonal."""
PAGE_CHARACTERS = 132
"""Characters of a legend across the page."""
TIME_MARKS = {"hour": 1, "shift": 8, "day": 24, "week": 168}
"""Hours of the times that are marked on an axis of operation."""


def _styles(study: StudyMeasurements) -> dict[str, LineStyle]:
    """The line style of each case, the same in all figures of a study."""
    return palette(list(study.cases), study.scenarios)


# Regrets of the runs


def draw_regrets(study: StudyMeasurements, scenario: str, width: float = WIDTH) -> Figure | None:
    """Regrets of all runs on a scenario; None where J* is unknown.

    Args:
        study: the measurements.
        scenario: its name.
        width: in inches.
    """
    if study.reference("optimum", scenario) is None:
        return None
    optimum = study.about["optimum"][scenario]
    summary = study.summary[study.summary.scenario == scenario]
    rows = []
    for row in summary.to_dict("records"):
        # The optimum is where the axis begins, and no row.
        if row["case"] != optimum:
            rows.append(_regret_dots(study, row))
    if not rows:
        return None
    return regret_figure(rows, _styles(study), width)


def _regret_dots(study: StudyMeasurements, row: Mapping[str, Any]) -> DotRow:
    """The regrets of a case's runs, in %.

    Args:
        study: the measurements.
        row: the case's row of the summary.
    """
    case = str(row["case"])
    scenario = str(row["scenario"])
    # Of a single run there is an interval over the noise alone, which is the median's.
    kind = "regret_iqm" if row["runs"] > 1 else "regret_median"
    status = study.runs_of(case, scenario).status
    diverged = status.str.startswith("diverged").to_numpy()
    return DotRow(
        case,
        values=100 * study.regrets(case, scenario),
        finished=~diverged,
        middle=100 * row[kind],
        low=100 * row[f"{kind}_low"],
        high=100 * row[f"{kind}_high"],
    )


def regret_figure(
    rows: Sequence[DotRow],
    styles: Mapping[str, LineStyle],
    width: float = WIDTH,
) -> Figure:
    """A row for each case: its runs, their interquartile mean and its 95 % interval.

    A run that diverged is a cross; an interval that goes on to the left of the axes ends in an
    arrow. The least middle is first; the axis is logarithmic above 0.01 %.

    Args:
        rows: regrets of each case, in %.
        styles: line style of each case.
        width: in inches.
    """
    rows = sorted(rows, key=lambda row: row.middle)
    with style.figure(0.21 * len(rows) + 1.3, width) as drawn:
        axes = drawn.subplots()
        values = style.dot_rows(axes, rows, styles)
        upper_ends = [row.high for row in rows]
        # Lower ends may be below 0, and the axis need not reach them.
        shown_values = np.concatenate([values, [0.0], upper_ends])
        style.regret_axis(axes, "x", shown_values)
        # An arrow stands where an interval leaves the axes.
        left, _ = axes.get_xlim()
        cut = [position for position, row in enumerate(rows) if row.low < left]
        # Of an empty line, not clipped, the layout believes that it lies at the page's foot.
        if cut:
            axes.plot(
                np.full(len(cut), left),
                cut,
                "<",
                color=style.INK,
                markersize=3,
                clip_on=False,
            )
        axes.set_xlabel("regret %: cost above the least possible")
        style.ask(
            drawn,
            "How close does each case come to the best possible?",
            "Dots: training runs; crosses: diverged. Bars: interquartile mean, 95 % interval.",
        )
    return drawn


# Learning curves


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


def draw_curves(study: StudyMeasurements, scenario: str, width: float = WIDTH) -> Figure | None:
    """Learning curves on a scenario; None if no training was evaluated more than once.

    Args:
        study: the measurements.
        scenario: its name.
        width: in inches.
    """
    rows = study.curves[study.curves.scenario == scenario]
    # Rows of a controller are its cost on the noise of the curves.
    is_training = rows.training_seed.notna()
    trained = rows[is_training]
    # Baselines that are trained, too, are lines at the cost that they end with.
    learned = trained[~trained.case.isin(study.baselines)]
    evaluated = trained.dropna(subset="greedy_J")
    greedy = evaluated.groupby(RUN_KEYS).greedy_J
    has_course = (greedy.size() > 1).any()
    if learned.empty or not has_course:
        return None
    controllers = rows[~is_training].set_index("case").greedy_J
    at_the_end = greedy.last().groupby("case").median()
    costs = pd.concat([controllers, at_the_end])
    levels = _levels(study, scenario, costs)
    best = _optimal_cost(study, scenario, controllers)
    if best is not None:
        levels[:] = 100 * regrets(levels.to_numpy(), best)
    curves = {}
    for case, log in learned.groupby("case", sort=False):
        curves[str(case)] = learning_curve(log, best)
    is_relative = best is not None
    return curves_figure(
        curves,
        levels.to_dict(),
        _styles(study),
        relative=is_relative,
        width=width,
    )


def _optimal_cost(
    study: StudyMeasurements,
    scenario: str,
    controllers: pd.Series[float],
) -> float | None:
    """J* on the noise of the curves; None where it is not known.

    Args:
        study: the measurements.
        scenario: its name.
        controllers: greedy cost of each controller, by case.
    """
    optimum = study.about["optimum"].get(scenario)
    cost = float(controllers.get(optimum, np.nan))
    return cost if np.isfinite(cost) else None


def _levels(
    study: StudyMeasurements,
    scenario: str,
    costs: pd.Series[float],
) -> pd.Series[float]:
    """Greedy costs of the baselines that a figure of curves shows as lines.

    Args:
        study: the measurements.
        scenario: its name.
        costs: greedy cost of each controller, and of each training at its end, by case.
    """
    is_baseline = costs.index.isin(study.baselines)
    # The optimum is where a regret is 0, and no line.
    is_optimum = costs.index == study.about["optimum"].get(scenario)
    levels = costs[is_baseline & ~is_optimum & np.isfinite(costs)]
    levels = levels.sort_values(kind="stable")
    # Naive is kept, be it the worst: it is where the curves begin.
    is_naive = levels.index == study.about["naive"].get(scenario)
    naive_first = pd.concat([levels[is_naive], levels[~is_naive]])
    return naive_first[:MOST_LEVELS]


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
    padded = [_padded(points, n_points) for points in runs]
    # From runs of rows to rows of runs: (R, 3, K) to three times (R, K).
    _, training, greedy = np.stack(padded, axis=1)
    if best is not None:
        training = 100 * regrets(training, best)
        greedy = 100 * regrets(greedy, best)
    return LearningCurve(samples, training, greedy)


def _points_of_a_run(log: pd.DataFrame) -> Array:
    """Samples, mean training cost and greedy cost at each greedy evaluation of a run, (3, K)."""
    evaluated = log.greedy_J.notna()
    # Rows up to a greedy evaluation belong to it: number them by the evaluations that follow.
    from_the_end = evaluated[::-1].cumsum()
    evaluations_left = from_the_end[::-1]
    # Negative, so that the groups come in the order of the samples.
    training = log.J.groupby(-evaluations_left).mean()
    # Rows behind the last evaluation make no point.
    n_points = evaluated.sum()
    points = [
        log.samples[evaluated],
        training.iloc[:n_points],
        log.greedy_J[evaluated],
    ]
    return np.array(points, dtype=np.float64)


def _padded(values: Array, length: int) -> Array:
    """Rows of values (3, K), each followed by its last one, (3, length)."""
    n_missing = length - values.shape[1]
    return np.pad(values, ((0, 0), (0, n_missing)), mode="edge")


def curves_figure(
    curves: Mapping[str, LearningCurve],
    levels: Mapping[str, float],
    styles: Mapping[str, LineStyle],
    *,
    relative: bool,
    width: float = WIDTH,
) -> Figure:
    """Above the cost of the training samples, below the greedy policy's.

    More than six cases have a column for each θ that they start from. Lines are medians over runs,
    bands their quartiles, drawn where at most six cases are in a panel.

    Args:
        curves: curve of each case.
        levels: costs that are drawn across all panels, by name.
        styles: line style of each case.
        relative: whether costs are regrets in %.
        width: in inches; a narrow figure has one column.
    """
    unit = "regret %" if relative else "J"
    columns = _columns_by_start(curves)
    if width < style.NARROW:
        columns = {"": list(curves)}
    # As many names as lines and levels stand right of a panel.
    n_names = len(curves) + len(levels)
    height = max(2.6, 0.135 * n_names)
    training = {name: curve.training for name, curve in curves.items()}
    greedy = {name: curve.greedy for name, curve in curves.items()}
    rows = {
        "training samples": training,
        "greedy policy": greedy,
    }
    end = max(float(curve.samples[-1]) for curve in curves.values())
    with style.figure(2 * height + 0.8, width) as drawn:
        grid = drawn.subplots(
            2,
            len(columns),
            sharex=True,
            sharey="row",
            squeeze=False,
        )
        labels: list[tuple[Axes, list[EndLabel]]] = []
        for row, (kind, costs) in zip(grid, rows.items(), strict=True):
            for axes, (start, names) in zip(row, columns.items(), strict=True):
                panel = {name: curves[name] for name in names}
                lines = _median_lines(axes, start, panel, costs, styles)
                ends = style.cost_lines(axes, lines, levels, relative=relative)
            # The legend below names the rules of several panels; the last one names the levels.
            if start:
                ends = ends[: len(levels)]
            labels.append((axes, ends))
            if relative:
                # Panels of a row share their ordinate, which must show the data of all.
                limits = [axes.dataLim.intervaly for axes in row]
                style.regret_axis(row[0], "y", np.concatenate(limits))
            row[0].set_ylabel(f"{unit} of the {kind}")
        for axes, start in zip(grid[0], columns, strict=True):
            axes.set_title(start)
        for axes in grid[1]:
            style.samples_axis(axes, end, "training samples")
        if len(columns) > 1:
            _draw_rules_legend(drawn)
        most_curves = max(len(names) for names in columns.values())
        bands = "; bands: their quartiles" if most_curves <= BANDED else ""
        style.ask(
            drawn,
            "How many samples does each rule need?",
            f"Lines: medians over the runs{bands}.",
        )
        style.label_ends(drawn, labels)
    return drawn


def _columns_by_start(names: Iterable[str]) -> dict[str, list[str]]:
    """Cases by the title of their column; few cases have one column without a title."""
    all_names = list(names)
    by_start: dict[str, list[str]] = {}
    without_start: list[str] = []
    for name in all_names:
        _, _, settings = name.partition("start=")
        if not settings:
            without_start.append(name)
            continue
        # Another setting may follow, or the bracket of all.
        start, _, _ = settings.rstrip(")").partition(" ")
        by_start.setdefault(f"from {start}", []).append(name)
    columns = dict(by_start)
    if without_start:
        columns["others"] = without_start
    # One column parts nothing, and many columns are too narrow.
    if len(all_names) <= BANDED or not 1 < len(columns) < BANDED:
        return {"": all_names}
    return columns


def _median_lines(
    axes: Axes,
    start: str,
    curves: Mapping[str, LearningCurve],
    costs: Mapping[str, Array],
    styles: Mapping[str, LineStyle],
) -> list[style.CostLine]:
    """Medians of costs over the runs as lines to draw; draw their quartiles where they fit.

    Args:
        axes: where the quartiles are drawn.
        start: title of the column; empty where there is only one.
        curves: curve of each case of the panel, for its samples.
        costs: costs (R, K) of each case.
        styles: line style of each case.
    """
    # Beside other panels a case's line says its rule alone.
    dashes = palette(list(curves)) if start else styles
    # As it stands in the case's name.
    start_setting = start.replace("from", ",")
    lines = []
    for name, curve in curves.items():
        # A line ends where the first of its runs has diverged.
        is_finite = np.isfinite(costs[name]).all(axis=0)
        samples = curve.samples[is_finite]
        values = costs[name][:, is_finite]
        if not values.size:
            continue
        low, median, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
        color = styles[name].color
        look: dict[str, Any] = {
            "color": color,
            "linestyle": dashes[name].line,
            "marker": dashes[name].marker,
            "markersize": 3.5,
            # As a share of the panel: curves have some or hundreds of points.
            "markevery": MARKER_DISTANCE,
            "linewidth": 1.3,
            "label": shown_case(name).replace(start_setting, ""),
        }
        lines.append(style.CostLine(name, samples, median, look, dashes[name].marker))
        if len(values) > 1 and len(curves) <= BANDED:
            axes.fill_between(
                samples,
                low,
                high,
                color=color,
                alpha=0.15,
                linewidth=0,
            )
    return lines


def _draw_rules_legend(drawn: Figure) -> None:
    """Name each rule once, below all panels."""
    lines: dict[str, Line2D] = {}
    for axes in drawn.axes:
        for line in axes.get_lines():
            rule = str(line.get_label())
            # matplotlib names lines without a label so.
            if not rule.startswith("_"):
                lines.setdefault(rule, line)
    # The line that stands before a name takes the room of ten characters, about.
    widest = 10 + max(len(rule) for rule in lines)
    drawn.legend(
        handles=list(lines.values()),
        loc="outside lower center",
        ncols=max(1, PAGE_CHARACTERS // widest),
    )


# Regret in operation


def draw_operation(study: StudyMeasurements, scenario: str, width: float = WIDTH) -> Figure | None:
    """Regret in operation on a scenario; None where there is no course to draw.

    Args:
        study: the measurements.
        scenario: its name.
        width: in inches.
    """
    if scenario not in study.scenarios_in_operation:
        return None
    result = study.operation_result(scenario)
    if result.runs.samples.nunique() == 1:
        return None
    layout = study.operation_layout(scenario)
    return operation_figure(result, layout, _styles(study), study.baselines, width)


def operation_figure(
    result: OperationResult,
    layout: OperationLayout,
    styles: Mapping[str, LineStyle],
    baselines: Sequence[str],
    width: float = WIDTH,
) -> Figure:
    """Greedy regret and regret of the whole run against the plant's samples, on log axes.

    Lines are medians over the training seeds, bands from the best to the worst. Vertical lines
    stand at an hour, a shift, a day, a week, and where the plant changes.

    Args:
        result: the regrets of all runs.
        layout: the plant's sampling time and changes, and the cases that are drawn.
        styles: line style of each case.
        baselines: cases with a dashed line and no band.
        width: in inches; panels of a narrow figure stand below each other.
    """
    runs = result.runs
    if layout.drawn:
        runs = runs[runs.case.isin(layout.drawn)]
    first = float(runs.samples.min())
    last = float(runs.samples.max())
    titles = {
        "regret": "regret % of the θ learned so far",
        "life_regret": "regret % of the whole run so far",
    }
    # Both panels have one ordinate, so that what learning costs can be seen.
    all_regrets = 100 * runs[list(titles)].to_numpy(dtype=np.float64)
    is_narrow = width < style.NARROW
    shape = (2, 1) if is_narrow else (1, 2)
    with style.figure(3.1 * shape[0] + 0.7, width) as drawn:
        panels = drawn.subplots(*shape, sharey=True)
        ends = []
        for axes, (column, title) in zip(panels, titles.items(), strict=True):
            # Of θ on the plant as it is then: it jumps with the plant. The whole run's does not.
            breaks = layout.changes if column == "regret" else ()
            labels = _draw_regret_courses(axes, runs, column, styles, baselines, breaks)
            axes.set_xscale("log")
            axes.set_xlim(first, last)
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.xaxis.set_minor_formatter(NullFormatter())
            style.regret_axis(axes, "y", all_regrets)
            _mark_times(axes, layout.sampling_time, first, last)
            _mark_changes(axes, layout.changes, first, last)
            # From the left edge: a narrow panel is narrower than its title. The changes have a
            # line of their own, above the times.
            axes.set_title(title, loc="left", pad=20 if layout.changes else 12)
            axes.set_xlabel("samples of the plant")
            # Panels beside each other share their ordinate: names stand right of the last one.
            if is_narrow or axes is panels[-1]:
                ends.append((axes, labels))
        style.ask(
            drawn,
            "How good is each controller after so many samples?",
            "Lines: medians over the training seeds, measured at the markers; "
            "bands: the best to the worst run.",
        )
        style.label_ends(drawn, ends)
    return drawn


def _draw_regret_courses(
    axes: Axes,
    runs: pd.DataFrame,
    column: str,
    styles: Mapping[str, LineStyle],
    baselines: Sequence[str],
    breaks: Iterable[int] = (),
) -> list[EndLabel]:
    """Draw the regret of each case over the samples; return the cases' names for `label_ends`.

    Args:
        axes: where it is drawn.
        runs: a row for each run and mark.
        column: of the regret.
        styles: of which the colours are taken.
        baselines: cases with a dashed line and no band.
        breaks: samples before which the lines are interrupted.
    """
    # Dashes are of the cases that are drawn, colours the same in all figures of the study.
    dashes = palette(list(runs.case.unique()))
    labels = []
    for group, rows in runs.groupby("case", sort=False):
        case = str(group)
        color = styles[case].color
        regrets_at_marks = rows.groupby("samples")[column]
        spread = 100 * regrets_at_marks.agg(["min", "median", "max"])
        end = float(spread["median"].iloc[-1])
        # A rule's variants have markers of their own, which tell them apart.
        marker = dashes[case].marker
        labels.append(EndLabel(shown_case(case), end, color, marker))
        for sample in breaks:
            # No line leads from a mark before to one after it.
            spread.loc[sample - 0.5] = np.nan
        spread = spread.sort_index()
        is_baseline = case in baselines
        axes.plot(
            spread.index,
            spread["median"],
            color=color,
            linestyle=DASHED if is_baseline else dashes[case].line,
            linewidth=0.9 if is_baseline else 1.5,
            # Between the marks nothing was measured.
            marker=marker or ".",
            markersize=3.5,
            # The first and the last mark lie at the edges of the axes.
            clip_on=False,
        )
        if not is_baseline:
            axes.fill_between(
                spread.index,
                spread["min"],
                spread["max"],
                color=color,
                alpha=0.12,
                linewidth=0,
            )
    return labels


def _mark_times(axes: Axes, sampling_time: float, first: float, last: float) -> None:
    """Draw a line at an hour, a shift, a day and a week of samples, on a log axis.

    Args:
        axes: where they are drawn.
        sampling_time: of the plant, in s.
        first: least sample of the axis.
        last: largest sample of the axis.
    """
    for name, hours in TIME_MARKS.items():
        samples = hours * 3600.0 / sampling_time
        if not first <= samples <= last:
            continue
        dotted = (0, (1, 2))
        axes.axvline(samples, color=style.REFERENCE, linewidth=0.7, linestyle=dotted)
        _name_line(axes, name, samples, height=2.0, color=style.REFERENCE)


def _mark_changes(
    axes: Axes,
    changes: Mapping[int, Mapping[str, float]],
    first: float,
    last: float,
) -> None:
    """Draw a line where the plant changes, named by what its parameters then are.

    Args:
        axes: where they are drawn.
        changes: new values of the plant's parameters, by the sample.
        first: least sample of the axis.
        last: largest sample of the axis.
    """
    for sample, parameters in changes.items():
        if not first <= sample <= last:
            continue
        values = [f"{style.label(name, '')} = {value:g}" for name, value in parameters.items()]
        axes.axvline(sample, color=style.BOUND, linewidth=0.9)
        # Above the names of the times, which may stand close by.
        _name_line(axes, ", ".join(values), sample, height=10.5, color=style.BOUND)


def _name_line(axes: Axes, name: str, sample: float, height: float, color: str) -> None:
    """Write the name of a vertical line above the axes, a log axis of samples.

    Args:
        axes: where it is written.
        name: what is written.
        sample: where the line stands.
        height: above the axes, in points.
        color: of the letters.
    """
    first, last = axes.get_xlim()
    # Near an edge the name is set inwards.
    position = np.log(sample / first) / np.log(last / first)
    side = "center"
    if position < 0.06:
        side = "left"
    elif position > 0.94:
        side = "right"
    axes.annotate(
        name,
        (sample, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(0, height),
        textcoords="offset points",
        ha=side,
        fontsize=6.5,
        color=color,
    )


STUDY_FIGURES: dict[str, Callable[[StudyMeasurements, str, float], Figure | None]] = {
    "curves": draw_curves,
    "regret": draw_regrets,
    "operation": draw_operation,
}
"""Drawing functions of the kinds of figures of a scenario."""
