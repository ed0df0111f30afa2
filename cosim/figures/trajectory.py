"""A run over time: states and inputs with their bounds, disturbances, costs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cosim.figures.style import BOUND, REFERENCE, SERIES, figure, label, limit, plain, save
from cosim.scenario import Scenario
from cosim.trajectory import Trajectory

Array = NDArray[np.float64]


def plot_trajectory(
    trajectory: Trajectory,
    scenario: Scenario,
    path: str | Path,
    *,
    beside: Sequence[Trajectory] = (),
) -> Path:
    """Draw a run to a PNG or SVG file; raises FigureError as `save` does."""
    return save(trajectory_figure(trajectory, scenario, beside=beside), path)


def trajectory_figure(
    trajectory: Trajectory, scenario: Scenario, *, beside: Sequence[Trajectory] = ()
) -> Figure:
    """Left: states, then inputs, with bounds (red) and operating point (grey).

    Right: disturbances and the cost per sample. Inputs, disturbances and costs hold from one
    sample to the next. Violated bounds are shaded, fallback actions marked; a bound that is far
    from the data is named in place of drawn. The axes span the runs `beside` this one too, so
    that figures of a set can be compared.
    """
    plant, units = scenario.plant, {k: s.unit for k, s in trajectory.signals.items()}
    scale, unit = time_unit(trajectory.time)
    time = trajectory.time / scale
    left = [*plant.states, *plant.actions]
    right = [*plant.disturbances, "stage_cost", "penalty"]
    rows = np.lcm(len(left), len(right))
    height = max(1.05 * max(len(left), len(right) * 0.8), 2.4)
    with figure(height + 0.5) as drawn:
        grid = drawn.add_gridspec(int(rows), 2, width_ratios=(1.35, 1.0))
        axes: dict[str, Axes] = {}
        for column, names in enumerate((left, right)):
            span = int(rows) // len(names)
            for i, name in enumerate(names):
                cell = grid[i * span : (i + 1) * span, column]
                axes[name] = drawn.add_subplot(cell, sharex=next(iter(axes.values()), None))
                axes[name].set_ylabel(label(name, units[name]), fontsize=7.0)
                axes[name].tick_params(labelbottom=i == len(names) - 1)
                for run in beside:
                    _span(axes[name], time, run[name])
            axes[names[-1]].set_xlabel(f"time [{unit}]")
        for i, name in enumerate(plant.states):
            lower, upper = float(scenario.state_lower[i]), float(scenario.state_upper[i])
            _state(axes[name], time, trajectory[name], lower, upper, SERIES[0])
            axes[name].axhline(scenario.reference_state[i], color=REFERENCE, linewidth=0.7)
        for i, name in enumerate(plant.actions):
            axes[name].step(time, trajectory[name], where="post", color=SERIES[2], linewidth=0.9)
            axes[name].axhline(scenario.reference_action[i], color=REFERENCE, linewidth=0.7)
            limits(axes[name], scenario.action_lower[i], scenario.action_upper[i])
            _failures(axes[name], time, trajectory[name], trajectory["failed"])
        for name in plant.disturbances:
            axes[name].step(time, trajectory[name], where="post", color=SERIES[3], linewidth=0.6)
        _cost(axes["stage_cost"], time, trajectory["stage_cost"], SERIES[4])
        _cost(axes["penalty"], time, trajectory["penalty"], SERIES[1])
        axes["penalty"].set_ylim(bottom=0.0)
        axes[left[0]].set_xlim(time[0], time[-1] + (time[1] - time[0] if len(time) > 1 else 1.0))
        drawn.align_ylabels()
        drawn.suptitle(_title(trajectory, scenario), fontsize=8.5)
    return drawn


def _title(trajectory: Trajectory, scenario: Scenario) -> str:
    summary = trajectory.summary()
    name = plain(f"{trajectory.controller or 'run'} on {scenario.name}")
    seed = "" if trajectory.seed is None else f", seed {trajectory.seed}"
    return (
        f"{name}{seed}:   "
        f"J = {summary['J']:.0f},   economic cost {summary['economic_cost']:.0f},   "
        f"violating {100 * summary['violating_share']:.1f} % of samples"
    )


def time_unit(time: Array) -> tuple[float, str]:
    """Seconds in the unit in which a run of this length reads best, and its name."""
    duration = float(time[-1])
    if duration <= 300.0:
        return 1.0, "s"
    return (60.0, "min") if duration <= 86400.0 else (3600.0, "h")


def _span(axes: Axes, time: Array, values: Array) -> None:
    """Make room for values that another figure shows."""
    axes.update_datalim([(time[0], np.min(values)), (time[0], np.max(values))])
    axes.autoscale_view()


def _state(axes: Axes, time: Array, values: Array, lower: float, upper: float, color: str) -> None:
    axes.plot(time, values, color=color, linewidth=0.9)
    for bound, outside in ((lower, values < lower), (upper, values > upper)):
        if outside.any():
            axes.fill_between(
                time, values, bound, where=list(outside), color=BOUND, alpha=0.35, linewidth=0
            )
    limits(axes, lower, upper)


def limits(axes: Axes, lower: float, upper: float) -> None:
    """Draw a bound where it is no farther from the data than they are wide, else name it."""
    low, high = axes.dataLim.intervaly
    span = max(high - low, 1e-9)
    far = []
    for name, bound, distance in (("≥", lower, low - lower), ("≤", upper, upper - high)):
        if distance < span:
            limit(axes, bound, f"{name} {bound:g}")
        else:
            far.append(f"{name} {bound:g}")
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


def _failures(axes: Axes, time: Array, values: Array, failed: Array) -> None:
    at = failed > 0
    if at.any():
        axes.plot(time[at], values[at], "x", color=BOUND, markersize=4, label="fallback")
        axes.legend(loc="upper right")


def _cost(axes: Axes, time: Array, values: Array, color: str) -> None:
    axes.step(time, values, where="post", color=color, linewidth=0.6)
    mean = float(np.mean(values))
    axes.axhline(mean, color="#222222", linewidth=0.8, linestyle=(0, (1, 1)))
    axes.annotate(
        f"mean {mean:.0f}" if abs(mean) >= 1000 else f"mean {mean:.4g}",
        (0.99, 0.95),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=6.5,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
    )
