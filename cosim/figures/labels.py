"""Names at the ends of lines, in place of a legend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

Array = NDArray[np.float64]


class EndLabel(NamedTuple):
    """A line's name as it is to be set, the ordinate at its end (data), and its colour."""

    text: str
    y: float
    color: str


def label_ends(axes: Axes, labels: Sequence[EndLabel], size: float = 6.5) -> None:
    """Write names right of the axes, each at its line's end, pushed apart where they overlap.

    The limits and the scale of the ordinate must be set before.
    """
    if not labels:
        return
    height = axes.get_window_extent().height * 72 / axes.figure.dpi
    low, high = (axes.transData.transform((0, y))[1] for y in axes.get_ylim())
    wanted = np.array(
        [(axes.transData.transform((0, item.y))[1] - low) / (high - low) for item in labels]
    )
    order = np.argsort(-np.clip(wanted, 0.0, 1.0), kind="stable")
    placed = spread(np.clip(wanted, 0.0, 1.0)[order], 1.25 * size / height)
    for position, index in zip(placed, order, strict=True):
        item = labels[index]
        end = float(np.clip(wanted[index], 0.0, 1.0))
        axes.annotate(
            item.text,
            xy=(1.0, end),
            xytext=(1.035, position),
            xycoords="axes fraction",
            textcoords="axes fraction",
            fontsize=size,
            color=item.color,
            va="center",
            ha="left",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": item.color, "linewidth": 0.5, "shrinkB": 0.0,
                        "shrinkA": 0.5, "relpos": (0.0, 0.5)},
        )  # fmt: skip


def spread(positions: Array, gap: float) -> Array:
    """Descending positions (K,) in [0, 1], moved as little as need be to be `gap` apart.

    They minimise the sum of the squared moves, within [0, 1]: an isotonic regression of
    `positions[i] + i·gap`, clipped. Where K gaps do not fit, the lowest is at 0.
    """
    steps = gap * np.arange(len(positions))
    placed: Array = isotonic_regression(positions + steps, increasing=False).x
    return np.clip(placed, steps[-1], max(1.0, steps[-1])) - steps
