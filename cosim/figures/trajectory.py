"""Runs over time: one in detail, several on the same disturbances, and a running episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from numpy.typing import NDArray
from PIL import Image

from cosim.core.errors import FigureError
from cosim.core.files import write_atomically
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.figures.style import (
    BOUND,
    DASHED,
    INK,
    NARROW,
    REFERENCE,
    WIDTH,
    LineStyle,
    ask,
    figure,
    label,
    palette,
    plain,
    shown_case,
)

DOTTED: Any = (0, (1, 1))
FRAME = 350
"""Milliseconds of an animation's frame."""
DrawnRun = Any
"""A `cosim.core.trajectory.Trajectory`, which imports this module."""


def trajectory_figure(
    trajectory: DrawnRun,
    scenario: Scenario,
    *,
    beside: Sequence[DrawnRun] = (),
    width: float = WIDTH,
) -> Figure:
    """States and inputs with bounds (red) and operating point (dotted), disturbances and costs.

    States and inputs have the controller's colour; inputs, disturbances and costs hold from one
    sample to the next. Violated bounds are shaded, fallback actions marked; a bound far from the
    data is named, not drawn.

    Args:
        trajectory: the run.
        scenario: its scenario.
        beside: other runs that the axes span too, so that figures of a set can be compared.
        width: in inches; panels of a narrow figure stand below each other.
    """
    scale, unit = time_unit(trajectory.time)
    time = trajectory.time / scale
    cost_colors = {"stage_cost": REFERENCE, "penalty": BOUND}
    # Left the states and inputs with their bounds, right what acts on the plant, and the costs.
    left = [*scenario.limits]
    right = [*scenario.plant.disturbances, *cost_colors]
    columns = [left, right]
    # Panels on the right may be a little lower than those of the loop.
    n_rows = max(len(left), len(right) * 0.8)
    if width < NARROW:
        columns = [[*left, *right]]
        n_rows = 0.8 * len(columns[0])
    height = max(1.05 * n_rows, 2.4) + 0.7
    with figure(height, width) as drawn:
        panels = _panel_columns(drawn, columns)
        for name, axes in panels.items():
            signal_unit = trajectory.signals[name].unit
            axes.set_ylabel(label(name, signal_unit), fontsize=7.0)
            for run in beside:
                _span(axes, time[0], run[name])
        _loop_panels(panels, time, trajectory, scenario)
        for name in right:
            color = cost_colors.get(name, REFERENCE)
            panels[name].step(
                time,
                trajectory[name],
                where="post",
                color=color,
                linewidth=0.6,
            )
        for name in cost_colors:
            mean = float(np.mean(trajectory[name]))
            _draw_mean(panels[name], mean)
        panels["penalty"].set_ylim(bottom=0.0)
        for names in (left, right):
            lowest = panels[names[-1]]
            lowest.set_xlabel(f"time [{unit}]")
        # The last input is held for a sample more.
        last_step = time[1] - time[0] if len(time) > 1 else 1.0
        end = time[-1] + last_step
        # All panels share their abscissa.
        panels[left[0]].set_xlim(time[0], end)
        for names in columns:
            drawn.align_ylabels([panels[name] for name in names])
        ask(
            drawn,
            "Does the loop keep its bounds?",
            _detail(trajectory, scenario),
        )
    return drawn


def _panel_columns(drawn: Figure, columns: Sequence[Sequence[str]]) -> dict[str, Axes]:
    """Panels by name in one or two columns, of which each is as high as the other.

    Args:
        drawn: the figure.
        columns: names of the panels of each column, from above; the first one is wider.
    """
    ratios = [1.35, 1.0][: len(columns)]
    outer = drawn.add_gridspec(1, len(columns), width_ratios=ratios)
    panels: dict[str, Axes] = {}
    shared: Axes | None = None
    for place, names in enumerate(columns):
        # A grid of its own: in a common one, panels of both would reach over several rows, and
        # the layout of some versions of matplotlib leaves them no height.
        grid = outer[place].subgridspec(len(names), 1)
        for row, name in enumerate(names):
            axes = drawn.add_subplot(grid[row], sharex=shared)
            # Times stand below the lowest panel of a column.
            axes.tick_params(labelbottom=name == names[-1])
            shared = shared or axes
            panels[name] = axes
    return panels


def _span(axes: Axes, time: float, values: Array) -> None:
    """Let an ordinate show values; an axis that follows its data needs points, at any time."""
    lowest = (time, np.min(values))
    highest = (time, np.max(values))
    axes.update_datalim([lowest, highest])
    axes.autoscale_view()


def _loop_panels(
    panels: Mapping[str, Axes],
    time: Array,
    trajectory: DrawnRun,
    scenario: Scenario,
) -> None:
    """Draw states and inputs, their bounds and operating point, and fallback actions."""
    controller = trajectory.controller or "run"
    color = palette([controller])[controller].color
    # In the order of the limits: states, then inputs.
    operating_point = np.append(scenario.reference_state, scenario.reference_action)
    failed = trajectory["failed"] > 0
    for name, reference in zip(scenario.limits, operating_point, strict=True):
        axes = panels[name]
        _line(axes, time, trajectory, name, color, width=0.9, shade=BOUND)
        moving = _moving_bounds(trajectory, name)
        for values in moving.values():
            axes.step(
                time,
                values,
                where="post",
                color=BOUND,
                linewidth=1.0,
                linestyle=DASHED,
            )
        # Where a bound moves, the scenario's own number would mislead.
        if not moving:
            lower, upper = scenario.limits[name]
            _limits(axes, lower, upper)
        axes.axhline(
            reference,
            color=REFERENCE,
            linewidth=0.7,
            linestyle=DOTTED,
            label="operating point",
        )
        _draw_known(axes, time, trajectory, name)
        if name in scenario.plant.actions and failed.any():
            axes.plot(
                time[failed],
                trajectory[name][failed],
                "x",
                color=BOUND,
                markersize=4,
                label="fallback",
            )
    _draw_marks_legend([panels[name] for name in scenario.limits])


def _draw_known(axes: Axes, time: Array, trajectory: DrawnRun, name: str) -> None:
    """Draw what sensors showed of a state, and its estimate, where there are any."""
    estimate = trajectory.signals.get(f"estimated[{name}]")
    measurement = trajectory.signals.get(f"measured[{name}]")
    if estimate is None and measurement is None:
        return
    if estimate is not None:
        axes.plot(
            time,
            estimate.values,
            color=INK,
            linewidth=0.6,
            linestyle=DASHED,
            label="estimated",
        )
    if measurement is not None:
        # As dots: between two of them a sensor showed nothing new.
        axes.plot(
            time,
            measurement.values,
            ".",
            color=INK,
            markersize=2.5,
            label="measured",
        )


def _draw_marks_legend(panels: Sequence[Axes]) -> None:
    """Name what is drawn in several panels once, above the first one and its far bounds."""
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    panels[0].legend(
        handles=list(handles.values()),
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=len(handles),
        fontsize=6.0,
        borderaxespad=1.6,
        handlelength=1.6,
        columnspacing=1.2,
    )


def _draw_mean(axes: Axes, mean: float) -> None:
    """Draw a mean as a dotted line, and its number in the corner."""
    axes.axhline(mean, color=INK, linewidth=0.8, linestyle=DOTTED)
    # `g` would write large numbers with an exponent.
    number = f"{mean:.0f}" if abs(mean) >= 1000 else f"{mean:.4g}"
    axes.annotate(
        f"mean {number}",
        (0.99, 0.95),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=6.5,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
    )


def _detail(trajectory: DrawnRun, scenario: Scenario) -> str:
    """The run and its costs in a line."""
    controller = shown_case(trajectory.controller or "run")
    seed = "" if trajectory.seed is None else f", seed {trajectory.seed}"
    summary = trajectory.summary()
    return (
        f"{controller} on {plain(scenario.name)}{seed}: "
        f"J = {summary['J']:.0f}, economic cost {summary['economic_cost']:.0f}, "
        f"{100 * summary['violating_share']:.1f} % of samples violate a bound (red)"
    )


def overlay_figure(runs: Mapping[str, DrawnRun], width: float = WIDTH) -> Figure:
    """States and inputs of runs of one scenario over time, a line for each controller.

    Below a violated lower bound, and above an upper one, the area is shaded in the controller's
    colour. The legend gives each J and the share of violating samples.
    """
    first = next(iter(runs.values()))
    scenario = first.scenario
    scale, unit = time_unit(first.time)
    styles = palette(list(runs))
    n_panels = len(scenario.limits)
    is_narrow = width < NARROW
    with figure(1.2 * n_panels + 1.0, width) as drawn:
        panels = _stacked_panels(drawn, n_panels)
        for axes, (name, bounds) in zip(panels, scenario.limits.items(), strict=True):
            for controller, run in runs.items():
                time = run.time / scale
                color = styles[controller].color
                _line(axes, time, run, name, color, width=1.1, shade=color)
            # After all lines: how far a bound is drawn depends on the data.
            lower, upper = bounds
            _limits(axes, lower, upper)
            signal_unit = first.signals[name].unit
            axes.set_ylabel(label(name, signal_unit))
        begin = first.time[0]
        # The last input is held for a sample more.
        end = first.time[-1] + scenario.sampling_time
        panels[-1].set_xlim(begin / scale, end / scale)
        panels[-1].set_xlabel(f"time [{unit}]")
        drawn.align_ylabels()
        _draw_costs_legend(panels[0], runs, styles, columns=1 if is_narrow else 2)
        ask(drawn, "How do the controllers act against the same disturbances?")
    return drawn


def _stacked_panels(drawn: Figure, count: int) -> list[Axes]:
    """Panels below each other that share their abscissa, from above."""
    grid = drawn.subplots(count, 1, sharex=True, squeeze=False)
    return list(grid[:, 0])


def _draw_costs_legend(
    axes: Axes,
    runs: Mapping[str, DrawnRun],
    styles: Mapping[str, LineStyle],
    columns: int,
) -> None:
    """Name each controller above the axes, with its J and the share of violating samples."""
    for controller, run in runs.items():
        summary = run.summary()
        text = (
            f"{shown_case(controller)}: J = {summary['J']:.0f}, "
            f"{100 * summary['violating_share']:.0f} % of samples violate"
        )
        # An empty line stands for the controller in the legend.
        axes.plot([], [], color=styles[controller].color, label=text)
    axes.plot([], [], color=BOUND, linestyle=DASHED, label="bound")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.02), ncols=columns, borderaxespad=0.2)


def animation(
    start: str,
    first: DrawnRun,
    name: str,
    runs: Mapping[str, DrawnRun],
    path: str | Path,
) -> Path:
    """Write a GIF: a frame for each run, drawn over the first one on the same axes.

    Args:
        start: the first run's name in the legend.
        first: the run that every frame has.
        name: the others' name in the legend.
        runs: a run for each frame, by the frame's title.
        path: of the file, which must end in .gif.

    Returns:
        The path.

    Raises:
        FigureError: on another suffix.
        OSError: if the file cannot be written.
    """
    if Path(path).suffix != ".gif":
        raise FigureError(f"cannot draw '{path}': the file must end in .gif")
    all_runs = [first, *runs.values()]
    values = {}
    for signal in first.scenario.limits:
        values[signal] = np.concatenate([run[signal] for run in all_runs])
    images = []
    for title, run in runs.items():
        drawn = overlay_figure({start: first, name: run})
        # All frames have one ordinate, so that the lines alone move.
        for axes, signal in zip(drawn.axes, values, strict=True):
            _fix_ordinate(axes, values[signal])
        drawn.axes[0].set_title(title, loc="right", fontsize=8.5, pad=16.0)
        images.append(Image.fromarray(_pixels(drawn)))
    durations = [FRAME] * len(images)
    # The last frame stays, before the animation begins again.
    durations[-1] = 6 * FRAME
    content = BytesIO()
    images[0].save(
        content,
        "GIF",
        save_all=True,
        append_images=images[1:],
        loop=0,
        duration=durations,
    )
    return write_atomically(path, content.getvalue())


def _fix_ordinate(axes: Axes, values: Array) -> None:
    """Show these values with a margin, and the names of those bounds that are in sight."""
    margin = 0.05 * float(np.ptp(values)) or 1.0
    low, high = axes.set_ylim(values.min() - margin, values.max() + margin)
    for text in axes.texts:
        # A bound's name stands at the bound in data, and its `xycoords` differ for x and y.
        if isinstance(text, Annotation) and isinstance(text.xycoords, tuple):
            _, bound = text.xy
            text.set_visible(low <= bound <= high)


def episode_image(
    scenario: Scenario,
    units: dict[str, str],
    first: int,
    states: Array,
    actions: Array,
) -> NDArray[np.uint8]:
    """An RGB image of an episode's last samples.

    Args:
        scenario: of the episode.
        units: of the states and actions, by name.
        first: number of the first sample shown.
        states: (K+1, n).
        actions: (K, m), between the states.

    Returns:
        The image, (height, width, 3).
    """
    samples = np.arange(first, first + len(states), dtype=float)
    # As a product: a sum of sampling times would drift.
    seconds: Array = scenario.sampling_time * samples
    scale, unit = time_unit(seconds)
    time = seconds / scale
    state_values = dict(zip(scenario.plant.states, states.T, strict=True))
    held_values = dict(zip(scenario.plant.actions, actions.T, strict=True))
    n_panels = len(scenario.limits)
    with figure(1.3 * n_panels, 6.0) as drawn:
        panels = _stacked_panels(drawn, n_panels)
        for axes, (name, bounds) in zip(panels, scenario.limits.items(), strict=True):
            axes.set_ylabel(label(name, units[name]))
            if name in state_values:
                axes.plot(time, state_values[name], color=INK)
            else:
                # An action is held from its sample to the next.
                axes.stairs(held_values[name], time, color=INK, baseline=None)
            lower, upper = bounds
            _limits(axes, lower, upper)
        panels[-1].set_xlabel(f"time [{unit}]")
        # After a reset there is one state, and no range.
        end = time[-1] if len(time) > 1 else time[0] + 1.0
        panels[-1].set_xlim(time[0], end)
        drawn.align_ylabels()
        return _pixels(drawn)


def _pixels(drawn: Figure) -> NDArray[np.uint8]:
    """A figure as an RGB image, (height, width, 3)."""
    # Without a screen, whatever backend the user has chosen.
    canvas: Any = FigureCanvasAgg(drawn)
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())
    return rgba[..., :3].copy()


def time_unit(time: Array) -> tuple[float, str]:
    """Seconds in the unit in which a run of this length reads best, and its name."""
    duration = float(time[-1])
    if duration <= 300.0:
        return 1.0, "s"
    if duration <= 86400.0:
        return 60.0, "min"
    return 3600.0, "h"


def _line(
    axes: Axes,
    time: Array,
    run: DrawnRun,
    name: str,
    color: str,
    width: float,
    shade: str,
) -> None:
    """Draw a state, or an input, which is held, and shade what is beyond its bounds."""
    values = run[name]
    lower: Any
    upper: Any
    lower, upper = run.scenario.limits[name]
    moving = _moving_bounds(run, name)
    lower = moving.get("x_l", lower)
    upper = moving.get("x_u", upper)
    is_held = name in run.scenario.plant.actions
    axes.plot(
        time,
        values,
        drawstyle="steps-post" if is_held else "default",
        color=color,
        linewidth=width,
    )
    for bound, violates in ((lower, values < lower), (upper, values > upper)):
        if not violates.any():
            continue
        axes.fill_between(
            time,
            values,
            bound,
            where=list(violates),
            color=shade,
            alpha=0.3,
            linewidth=0,
            interpolate=True,
        )


def _moving_bounds(run: DrawnRun, name: str) -> dict[str, Array]:
    """Bounds of a state that a signal moves along a run, (K,), by `x_l` and `x_u`."""
    moving = {}
    for signal in run.scenario.signals or ():
        if signal.bounded_state == name and signal.bound is not None:
            # A bound is written `x_l[X2]`.
            side = signal.bound[:3]
            moving[side] = run[f"signal[{signal.name}]"]
    return moving


def _limits(axes: Axes, lower: float, upper: float) -> None:
    """Draw a bound where it is no farther from the data than they are wide, else name it."""
    low, high = axes.dataLim.intervaly
    span = max(high - low, 1e-9)
    bounds = {
        "≥": (lower, low - lower),
        "≤": (upper, upper - high),
    }
    far = []
    for sign, (bound, distance) in bounds.items():
        text = f"{sign} {bound:g}"
        # Drawn from afar it would press the data into a line.
        if distance < span:
            _draw_bound(axes, bound, text)
        else:
            far.append(text)
    if far:
        axes.annotate(
            f"bound {', '.join(far)}",
            (1.0, 1.0),
            xycoords="axes fraction",
            ha="right",
            va="bottom",
            fontsize=6.5,
            color=BOUND,
        )


def _draw_bound(axes: Axes, bound: float, text: str) -> None:
    """Draw a bound across the axes, named right of them: within, the data would hide it."""
    axes.axhline(bound, color=BOUND, linewidth=1.0, linestyle=DASHED, zorder=3)
    axes.annotate(
        text,
        (1.0, bound),
        xycoords=("axes fraction", "data"),
        xytext=(3, 0),
        textcoords="offset points",
        ha="left",
        va="center",
        fontsize=6.5,
        color=BOUND,
    )
