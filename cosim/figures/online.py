"""The course of regret while learning goes on, under what changes meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from cosim.figures.style import (
    REFERENCE,
    EndLabel,
    figure,
    label,
    label_ends,
    palette,
    regret_axis,
    save,
)

Array = NDArray[np.float64]
Signals = Mapping[str, Mapping[str, tuple[Array, Array]]]
"""Samples and values (K,) by signal and case; one line where a signal is the same in all."""


@dataclass(frozen=True)
class Course:
    """Regret in % of R runs in K blocks, (R, K), that end at `samples` (K,)."""

    samples: Array
    regret: Array


def plot_online(
    courses: Mapping[str, Course], signals: Signals, period: int, path: str | Path
) -> Path:
    """Draw a panel for each signal, and below the mean regret over runs so far, block by block.

    The lower panel is the running mean since the start: what a case has cost until then. Vertical
    lines stand at multiples of `period` samples. Raises FigureError as `save` does.
    """
    looks = _looks(list(courses))
    rows = len(signals) + 2
    with figure(1.25 * rows + 1.2) as drawn:
        ratios = [1.0] * len(signals) + [1.7, 1.7]
        grid = drawn.subplots(rows, 1, sharex=True, squeeze=False, height_ratios=ratios)
        axes_column = [axes for (axes,) in grid]
        end = max(float(course.samples[-1]) for course in courses.values())
        for axes in axes_column:
            for edge in np.arange(period, end, period):
                axes.axvline(edge, color=REFERENCE, linewidth=0.6, linestyle=(0, (1, 2)))
        for axes, (name, lines) in zip(axes_column, signals.items(), strict=False):
            _signal(axes, name, lines, looks)
        blocks = {case: course.regret.mean(axis=0) for case, course in courses.items()}
        so_far = {
            case: np.cumsum(values) / np.arange(1, len(values) + 1)
            for case, values in blocks.items()
        }
        titles = ("regret % of the block", "regret % since the start")
        for axes, means, title in zip(axes_column[-2:], (blocks, so_far), titles, strict=True):
            for case, values in means.items():
                axes.plot(courses[case].samples, values, **looks[case])
            regret_axis(axes, "y", np.concatenate([[0.0], *means.values()]))
            axes.set_ylabel(title)
        axes_column[-1].set_xlim(0.0, end)
        axes_column[-1].xaxis.set_major_formatter(EngFormatter(sep=""))
        axes_column[-1].set_xlabel("samples of the run")
        drawn.draw_without_rendering()
        ends = [EndLabel(case, float(so_far[case][-1]), looks[case]["color"]) for case in courses]
        label_ends(axes_column[-1], ends)
    return save(drawn, path)


def _looks(cases: list[str]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each case."""
    return {
        case: {"color": look.color, "linestyle": look.line, "linewidth": 1.2}
        for case, look in palette(cases).items()
    }


def _signal(
    axes: Axes,
    name: str,
    lines: Mapping[str, tuple[Array, Array]],
    looks: Mapping[str, dict[str, Any]],
) -> None:
    values = [value for _, value in lines.values()]
    common = all(np.array_equal(value, values[0], equal_nan=True) for value in values)
    for case, (samples, value) in lines.items():
        known = ~np.isnan(value)
        look = {"color": REFERENCE, "linewidth": 1.2} if common else looks[case]
        axes.plot(samples[known], value[known], **look)
        if common:
            break
    axes.set_ylabel(label(name.removeprefix("theta "), ""))
