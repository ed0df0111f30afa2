"""Several controllers on the same disturbances, one above the other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from cosim.figures.style import BOUND, colors, figure, label, plain, save
from cosim.figures.trajectory import limits, time_unit
from cosim.trajectory import Trajectory


def plot_overlay(runs: Mapping[str, Trajectory], path: str | Path) -> Path:
    """Draw runs by controller to a PNG or SVG file; raises FigureError as `save` does."""
    return save(overlay_figure(runs), path)


def overlay_figure(runs: Mapping[str, Trajectory]) -> Figure:
    """States and inputs of runs of one scenario over time, a line for each controller.

    Below a violated lower bound, and above an upper one, the area is shaded in the controller's
    colour. The legend gives each J and the share of violating samples.
    """
    first = next(iter(runs.values()))
    scenario, plant = first.scenario, first.scenario.plant
    scale, unit = time_unit(first.time)
    color = colors(list(runs))
    with figure(1.2 * len(scenario.limits) + 0.6) as drawn:
        rows = drawn.subplots(len(scenario.limits), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (name, (lower, upper)) in zip(rows, scenario.limits.items(), strict=True):
            for controller, run in runs.items():
                time, values = run.time / scale, run[name]
                held = "steps-post" if name in plant.actions else "default"
                axes.plot(time, values, color=color[controller], linewidth=1.1, drawstyle=held)
                for bound, outside in ((lower, values < lower), (upper, values > upper)):
                    axes.fill_between(
                        time,
                        values,
                        bound,
                        where=list(outside),
                        color=color[controller],
                        alpha=0.3,
                        linewidth=0,
                        interpolate=True,
                    )
            limits(axes, lower, upper)
            axes.set_ylabel(label(name, first.signals[name].unit))
        rows[-1].set_xlabel(f"time [{unit}]")
        rows[-1].set_xlim(first.time[0] / scale, (first.time[-1] + scenario.sampling_time) / scale)
        drawn.align_ylabels()
        for controller, run in runs.items():
            summary = run.summary()
            rows[0].plot([], [], color=color[controller], label=_text(controller, summary))
        rows[0].plot([], [], color=BOUND, linestyle=(0, (4, 2)), label="bound")
        rows[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.02), ncols=2, borderaxespad=0.2)
    return drawn


def _text(controller: str, summary: Mapping[str, float]) -> str:
    violating = 100 * summary["violating_share"]
    return f"{plain(controller)}: J = {summary['J']:.0f}, {violating:.0f} % of samples violate"
