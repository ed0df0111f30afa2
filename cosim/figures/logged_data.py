"""The figure of what a log says of a plant's model, and what it does not say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cosim.figures.style import REFERENCE, figure, palette

MOST_DIRECTIONS = 8
"""Directions that are drawn at most."""


def known_figure(summary: Mapping[str, Any]) -> Figure:
    """Parameters' errors with two deviations, and the directions of them that are shown least.

    Grey is what was known before the log. A column on the right is a direction, a combination of
    parameters that the plant may have without being seen in the log; its head says what share of
    the prior variance the log has removed.

    Args:
        summary: of a `TrainingFromData`.
    """
    known = summary["parameters_known"]
    names = [parameter["name"] for parameter in known]
    places = np.arange(len(names))
    errors = np.array([100 * parameter["change"] for parameter in known])
    deviations = np.array([100 * parameter["deviation"] for parameter in known])
    prior = 100 * summary["prior_deviation"]
    directions = summary["directions"][:MOST_DIRECTIONS]
    color = palette(["learned"])["learned"].color
    with figure(0.22 * len(names) + 1.2) as drawn:
        left, right = drawn.subplots(1, 2, sharey=True)
        left.axvspan(-2 * prior, 2 * prior, color=REFERENCE, alpha=0.2, linewidth=0)
        left.errorbar(errors, places, xerr=2 * deviations, fmt="o", color=color, markersize=3)
        left.axvline(0.0, color=REFERENCE, linewidth=0.8)
        left.set_yticks(places, names)
        left.set_ylim(len(names) - 0.5, -0.5)
        left.set_xlabel("error of the model's value, %")
        weights = np.array([direction["weights"] for direction in directions]).T
        right.imshow(weights, cmap="RdBu", vmin=-1, vmax=1, aspect="auto")
        heads = [f"{100 * max(direction['shown'], 0.0):.0f}" for direction in directions]
        right.set_xticks(np.arange(len(directions)), heads)
        right.set_xlabel("directions: shown by the log, %")
    return drawn
