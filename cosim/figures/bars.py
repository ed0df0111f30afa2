"""Bars of regrets on a log axis, each with its name and its value: a picture without a legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.figures import style

PHONE_WIDTH = 4.4
"""Width in inches at which the house's letters can be read on a screen of 400 pixels."""
ROW = 0.245
"""Height of a row in inches."""


class Bar(NamedTuple):
    """A name, its regret in %, and its colour."""

    name: str
    regret: float
    color: str


def bars_figure(
    groups: Mapping[str, Sequence[Bar]],
    title: str,
    axis_label: str,
    floor: float = 0.01,
) -> Figure:
    """Regrets as bars from a floor on, in groups below each other.

    Args:
        groups: bars of each group, by its heading; all regrets above the floor.
        title: the question that the picture answers.
        axis_label: says what a bar's length is.
        floor: regret in % where the log axis begins.
    """
    n_rows = sum(1 + len(bars) for bars in groups.values())
    with style.figure(ROW * n_rows + 0.9, PHONE_WIDTH) as drawn:
        axes = drawn.subplots()
        names = []
        positions = []
        row = 0
        largest = floor
        for heading, bars in groups.items():
            _draw_heading(axes, row, heading)
            for bar in bars:
                row += 1
                _draw_bar(axes, row, bar, floor)
                positions.append(row)
                names.append(bar.name)
                largest = max(largest, bar.regret)
            row += 1
        axes.set_xscale("log")
        # Room for the value behind the longest bar.
        axes.set_xlim(floor, 8 * largest)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_yticks(positions, names)
        axes.tick_params(axis="y", length=0, labelsize=9.0)
        axes.tick_params(axis="x", labelsize=8.0)
        # The first row is above.
        axes.set_ylim(n_rows - 0.4, -0.5)
        axes.grid(axis="y", visible=False)
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(axis_label, fontsize=8.5)
        drawn.suptitle(title, fontsize=10.5, fontweight="bold", x=0.01, ha="left")
    return drawn


def _draw_heading(axes: Axes, row: int, text: str) -> None:
    """Write a group's heading above its bars, left of the axes as their names are."""
    axes.annotate(
        text,
        (0.0, row),
        xycoords=("axes fraction", "data"),
        xytext=(4, -1),
        textcoords="offset points",
        va="center",
        fontsize=9.0,
        fontweight="bold",
        color=style.INK,
    )


def _draw_bar(axes: Axes, row: int, bar: Bar, floor: float) -> None:
    """Draw a bar from the floor to its regret, and write the regret behind it."""
    axes.barh(row, bar.regret - floor, left=floor, height=0.72, color=bar.color)
    axes.annotate(
        f"{bar.regret:.2g} %" if bar.regret < 100 else f"{bar.regret:.0f} %",
        (bar.regret, row),
        xytext=(3, 0),
        textcoords="offset points",
        va="center",
        fontsize=9.0,
        color=style.INK,
    )
