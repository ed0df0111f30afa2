"""The figure of a controller in the shadow of a log."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.core.protocols import Array
from cosim.figures.style import BOUND, DASHED, REFERENCE, ask, figure, label, palette
from cosim.figures.trajectory import time_unit

ShownShadow = Any
"""A `cosim.shadow.Shadow`, which imports this module."""


def shadow_figure(shadow: ShownShadow) -> Figure:
    """Actions as logged (grey) and as proposed (colour), and what was given; bounds are dashed.

    Args:
        shadow: the result.
    """
    scenario = shadow.scenario
    scale, unit = time_unit(shadow.time - shadow.time[0])
    time = (shadow.time - shadow.time[0]) / scale
    color = palette([shadow.controller])[shadow.controller].color
    actions = scenario.plant.actions
    n_panels = len(actions) + len(shadow.given_names)
    with figure(1.2 * n_panels + 0.6) as drawn:
        panels = drawn.subplots(n_panels, 1, sharex=True, squeeze=False)[:, 0]
        for i, name in enumerate(actions):
            axes = panels[i]
            axes.step(time, shadow.logged[:, i], where="post", color=REFERENCE, label="logged")
            axes.step(
                time,
                shadow.proposed[:, i],
                where="post",
                color=color,
                linewidth=0.8,
                label=shadow.controller,
            )
            axes.set_ylabel(label(name, ""))
            _bounds(axes, scenario.limits[name])
        for i, name in enumerate(shadow.given_names):
            axes = panels[len(actions) + i]
            _given(axes, time, shadow.given[:, i])
            axes.set_ylabel(label(name, ""))
            _bounds(axes, scenario.limits.get(name, (-np.inf, np.inf)))
        panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
        panels[-1].set_xlabel(f"time since the log's first row [{unit}]")
        drawn.align_ylabels()
        ask(drawn, "Where would the controller have acted otherwise?")
    return drawn


def _given(axes: Axes, time: Array, values: Array) -> None:
    """Draw what was given; of a sensor that is read now and then its readings alone."""
    known = ~np.isnan(values)
    marker = "" if known.all() else "."
    axes.plot(time[known], values[known], color=REFERENCE, linewidth=0.8, marker=marker)


def _bounds(axes: Axes, bounds: tuple[float, float]) -> None:
    """Draw a bound where it is no farther from the data than they are wide."""
    low, high = axes.dataLim.intervaly
    span = max(high - low, 1e-9)
    for bound in bounds:
        if low - span < bound < high + span:
            axes.axhline(bound, color=BOUND, linewidth=0.8, linestyle=DASHED)
