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

from cosim.errors import FigureError
from cosim.figures.style import (
    BOUND,
    DASHED,
    INK,
    REFERENCE,
    figure,
    label,
    palette,
    plain,
    shown_case,
)
from cosim.files import write_atomically
from cosim.protocols import Array
from cosim.scenario import Scenario

FRAME = 350
"""Milliseconds of an animation's frame."""
Run = Any
"""A `cosim.trajectory.Trajectory`, which imports this module."""


def trajectory_figure(trajectory: Run, scenario: Scenario, *, beside: Sequence[Run] = ()) -> Figure:
    """States and inputs with bounds (red) and operating point (grey), disturbances and costs.

    States and inputs have the controller's colour; inputs, disturbances and costs hold from one
    sample to the next. Violated bounds are shaded, fallback actions marked; a bound far from the
    data is named, not drawn. The axes span the runs `beside` this one too, so that figures of a
    set can be compared.
    """
    units = {name: signal.unit for name, signal in trajectory.signals.items()}
    scale, unit = time_unit(trajectory.time)
    time = trajectory.time / scale
    who = trajectory.controller or "run"
    color = palette([who])[who].color
    held, costs = scenario.plant.disturbances, {"stage_cost": REFERENCE, "penalty": BOUND}
    left, right = [*scenario.limits], [*held, *costs]
    rows = int(np.lcm(len(left), len(right)))
    cells: Any = [
        [names[row * len(names) // rows] for names in (left, right)] for row in range(rows)
    ]
    references = np.append(scenario.reference_state, scenario.reference_action)
    failed = trajectory["failed"] > 0
    with figure(max(1.05 * max(len(left), len(right) * 0.8), 2.4) + 0.5) as drawn:
        panels = drawn.subplot_mosaic(cells, sharex=True, width_ratios=(1.35, 1.0))
        for name, axes in panels.items():
            axes.set_ylabel(label(name, units[name]), fontsize=7.0)
            for run in beside:
                values = run[name]
                axes.update_datalim([(time[0], np.min(values)), (time[0], np.max(values))])
                axes.autoscale_view()
        for name, reference in zip(left, references, strict=True):
            axes, values = panels[name], trajectory[name]
            _line(axes, time, trajectory, name, BOUND, color=color, linewidth=0.9)
            _limits(axes, *scenario.limits[name])
            axes.axhline(reference, color=REFERENCE, linewidth=0.7)
            if name in scenario.plant.actions and failed.any():
                axes.plot(time[failed], values[failed], "x", color=BOUND, ms=4, label="fallback")
                axes.legend(loc="upper right")
        for name in right:
            shade = costs.get(name, REFERENCE)
            panels[name].step(time, trajectory[name], where="post", color=shade, linewidth=0.6)
        for name in costs:
            mean = float(np.mean(trajectory[name]))
            panels[name].axhline(mean, color=INK, linewidth=0.8, linestyle=(0, (1, 1)))
            panels[name].annotate(
                f"mean {mean:.0f}" if abs(mean) >= 1000 else f"mean {mean:.4g}",
                (0.99, 0.95), xycoords="axes fraction", ha="right", va="top", fontsize=6.5,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
            )  # fmt: skip
        panels["penalty"].set_ylim(bottom=0.0)
        for names in (left, right):
            panels[names[-1]].set_xlabel(f"time [{unit}]")
        panels[left[0]].set_xlim(time[0], time[-1] + (time[1] - time[0] if len(time) > 1 else 1.0))
        drawn.align_ylabels()
        summary = trajectory.summary()
        seed = "" if trajectory.seed is None else f", seed {trajectory.seed}"
        drawn.suptitle(
            f"{shown_case(who)} on {plain(scenario.name)}{seed}:   "
            f"J = {summary['J']:.0f},   economic cost {summary['economic_cost']:.0f},   "
            f"violating {100 * summary['violating_share']:.1f} % of samples"
        )
    return drawn


def overlay_figure(runs: Mapping[str, Run]) -> Figure:
    """States and inputs of runs of one scenario over time, a line for each controller.

    Below a violated lower bound, and above an upper one, the area is shaded in the controller's
    colour. The legend gives each J and the share of violating samples.
    """
    first = next(iter(runs.values()))
    scenario = first.scenario
    scale, unit = time_unit(first.time)
    looks = palette(list(runs))
    with figure(1.2 * len(scenario.limits) + 0.6) as drawn:
        rows = drawn.subplots(len(scenario.limits), 1, sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(rows, scenario.limits, strict=True):
            for controller, run in runs.items():
                color = looks[controller].color
                _line(axes, run.time / scale, run, name, color, color=color, linewidth=1.1)
            _limits(axes, *scenario.limits[name])
            axes.set_ylabel(label(name, first.signals[name].unit))
        rows[-1].set_xlabel(f"time [{unit}]")
        rows[-1].set_xlim(first.time[0] / scale, (first.time[-1] + scenario.sampling_time) / scale)
        drawn.align_ylabels()
        for controller, run in runs.items():
            summary = run.summary()
            violating = f"{100 * summary['violating_share']:.0f} % of samples violate"
            text = f"{shown_case(controller)}: J = {summary['J']:.0f}, {violating}"
            rows[0].plot([], [], color=looks[controller].color, label=text)
        rows[0].plot([], [], color=BOUND, linestyle=DASHED, label="bound")
        rows[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.02), ncols=2, borderaxespad=0.2)
    return drawn


def animation(start: str, first: Run, name: str, runs: Mapping[str, Run], path: str | Path) -> Path:
    """Write a GIF: a frame for each of `runs`, by title, drawn over the `first` on the same axes.

    `start` and `name` are the legend's names of the first and the others. Raises FigureError on
    another suffix, OSError where the file cannot be written.
    """
    if Path(path).suffix != ".gif":
        raise FigureError(f"cannot draw '{path}': the file must end in .gif")
    images = []
    for title, run in runs.items():
        drawn = overlay_figure({start: first, name: run})
        for axes, signal in zip(drawn.axes, first.scenario.limits, strict=True):
            values = np.concatenate([one[signal] for one in (first, *runs.values())])
            margin = 0.05 * float(np.ptp(values)) or 1.0
            low, high = axes.set_ylim(values.min() - margin, values.max() + margin)
            for text in axes.texts:
                if isinstance(text, Annotation) and isinstance(text.xycoords, tuple):
                    text.set_visible(low <= text.xy[1] <= high)  # a bound in sight
        drawn.axes[0].set_title(title, loc="right", fontsize=8.5, pad=16.0)
        images.append(Image.fromarray(_pixels(drawn)))
    content = BytesIO()
    images[0].save(
        content, "GIF", save_all=True, append_images=images[1:], loop=0,
        duration=[*[FRAME] * (len(images) - 1), 6 * FRAME],
    )  # fmt: skip
    return write_atomically(path, content.getvalue())


def episode_image(
    scenario: Scenario, units: dict[str, str], first: int, states: Array, actions: Array
) -> NDArray[np.uint8]:
    """An RGB image (height, width, 3) of an episode's last samples, from sample `first` on.

    `states` (K+1, n), `actions` (K, m) between them; `units` maps variables' names to their units.
    """
    plant = scenario.plant
    seconds: Array = scenario.sampling_time * np.arange(first, first + len(states), dtype=float)
    scale, unit = time_unit(seconds)
    time = seconds / scale
    names = [*plant.states, *plant.actions]
    with figure(1.3 * len(names), 6.0) as drawn:
        panels = drawn.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for i in range(len(plant.states)):
            panels[i].plot(time, states[:, i], color=INK)
            _limits(panels[i], scenario.state_lower[i], scenario.state_upper[i])
        for j, panel in enumerate(panels[len(plant.states) :]):
            panel.stairs(actions[:, j], time, color=INK, baseline=None)
            _limits(panel, scenario.action_lower[j], scenario.action_upper[j])
        for panel, name in zip(panels, names, strict=True):
            panel.set_ylabel(label(name, units[name]))
        panels[-1].set_xlabel(f"time [{unit}]")
        panels[-1].set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1.0)
        drawn.align_ylabels()
        return _pixels(drawn)


def _pixels(drawn: Figure) -> NDArray[np.uint8]:
    canvas: Any = FigureCanvasAgg(drawn)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def time_unit(time: Array) -> tuple[float, str]:
    """Seconds in the unit in which a run of this length reads best, and its name."""
    duration = float(time[-1])
    if duration <= 300.0:
        return 1.0, "s"
    return (60.0, "min") if duration <= 86400.0 else (3600.0, "h")


def _line(axes: Axes, time: Array, run: Run, name: str, shade: str, **look: Any) -> None:
    """Draw a state, or an input, which is held, and shade what is beyond its bounds."""
    values, (lower, upper) = run[name], run.scenario.limits[name]
    held = "steps-post" if name in run.scenario.plant.actions else "default"
    axes.plot(time, values, drawstyle=held, **look)
    for bound, outside in ((lower, values < lower), (upper, values > upper)):
        if outside.any():
            axes.fill_between(
                time, values, bound, where=list(outside), color=shade, alpha=0.3, linewidth=0,
                interpolate=True,
            )  # fmt: skip


def _limits(axes: Axes, lower: float, upper: float) -> None:
    """Draw a bound where it is no farther from the data than they are wide, else name it."""
    low, high = axes.dataLim.intervaly
    span = max(high - low, 1e-9)
    far = []
    for name, bound, distance in (("≥", lower, low - lower), ("≤", upper, upper - high)):
        if distance >= span:
            far.append(f"{name} {bound:g}")
            continue
        axes.axhline(bound, color=BOUND, linewidth=1.0, linestyle=DASHED, zorder=3)
        # Right of the axes: within, the data would hide it.
        axes.annotate(
            f"{name} {bound:g}", (1.0, bound), xycoords=("axes fraction", "data"), xytext=(3, 0),
            textcoords="offset points", ha="left", va="center", fontsize=6.5, color=BOUND,
        )  # fmt: skip
    if far:
        axes.annotate(
            f"bound {', '.join(far)}", (1.0, 1.0), xycoords="axes fraction", ha="right",
            va="bottom", fontsize=6.5, color=BOUND,
        )  # fmt: skip
