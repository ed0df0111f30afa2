"""The figure of what a log says of a plant's model, and what it does not say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.figures.style import REFERENCE, figure, palette

LEARNED = palette(["learned"])["learned"].color
MOST_DIRECTIONS = 8
"""Directions that are drawn at most."""


def known_figure(summary: Mapping[str, Any]) -> Figure:
    """What a log says of the model, and of the bounds of θ.

    On the left the errors of the model's parameters with two deviations; grey is what was known
    before the log. In the middle the directions of them that are shown least: a column is a
    combination of parameters that the plant may have without being seen in the log, and its foot
    says what share of the prior variance the log has removed. On the right what moving each bound
    of θ is predicted to cost, with its 95 % interval: grey where the log does not tell if that is
    better or worse.

    Args:
        summary: of a `TrainingFromData`.
    """
    known = summary["parameters_known"]
    moves = summary["moves"]
    rows = max(len(known), len(moves))
    with figure(0.22 * rows + 1.2) as drawn:
        left, middle, right = drawn.subplots(1, 3, width_ratios=[3, 2, 3])
        _draw_errors(left, known)
        _draw_directions(middle, summary["directions"][:MOST_DIRECTIONS], len(known))
        _draw_moves(right, moves)
    return drawn


def _draw_errors(axes: Axes, known: Sequence[Mapping[str, Any]]) -> None:
    """Errors of parameters, before and after the log."""
    places = np.arange(len(known))
    errors = [100 * parameter["change"] for parameter in known]
    deviations = np.array([100 * parameter["deviation"] for parameter in known])
    prior = np.array([100 * parameter["prior_deviation"] for parameter in known])
    # Two deviations to either side.
    axes.barh(places, 4 * prior, left=-2 * prior, height=1.0, color=REFERENCE, alpha=0.2)
    bars = 2 * deviations
    axes.errorbar(errors, places, xerr=bars, fmt="o", color=LEARNED, markersize=3)
    axes.axvline(0.0, color=REFERENCE, linewidth=0.8)
    axes.set_yticks(places, [parameter["name"] for parameter in known])
    axes.set_ylim(len(known) - 0.5, -0.5)
    axes.set_xlabel("error of the model's value, %")


def _draw_directions(axes: Axes, directions: Sequence[Mapping[str, Any]], count: int) -> None:
    """Directions of the parameters, of which there are `count`: a column each."""
    weights = np.array([direction["weights"] for direction in directions]).T
    axes.imshow(weights, cmap="RdBu", vmin=-1, vmax=1, aspect="auto")
    feet = [f"{100 * max(direction['shown'], 0.0):.0f}" for direction in directions]
    axes.set_xticks(np.arange(len(directions)), feet)
    axes.set_yticks(np.arange(count), [""] * count)
    axes.set_xlabel("directions: shown, %")


def _draw_moves(axes: Axes, moves: Sequence[Mapping[str, Any]]) -> None:
    """Predicted cost of moving each bound."""
    labels = []
    for place, move in enumerate(moves):
        labels.append(f"{move['bound']}, by {move['by']:+.2g}")
        # A bound that is moved to where the plant runs away has no interval.
        if move["interval"] is None:
            axes.annotate("runs away", (0.0, place), va="center")
            continue
        low, high = move["interval"]
        color = LEARNED if move["is_told"] else REFERENCE
        axes.plot([low, high], [place, place], color=color)
        axes.plot([move["difference"]], [place], "o", color=color, markersize=3)
    axes.axvline(0.0, color=REFERENCE, linewidth=0.8)
    axes.set_yticks(np.arange(len(moves)), labels)
    axes.yaxis.tick_right()
    axes.set_ylim(len(moves) - 0.5, -0.5)
    # Costs of violations are a thousand times those of back-offs.
    sizes = [abs(move["difference"]) for move in moves if np.isfinite(move["difference"])]
    linear = 10.0 ** np.floor(np.log10(max(sizes, default=0.0) or 1.0) - 3)
    axes.set_xscale("symlog", linthresh=linear)
    ends = [-100 * linear, 0.0, 100 * linear]
    axes.set_xticks(ends, [f"{end:g}" for end in ends])
    axes.minorticks_off()
    axes.set_xlabel("bound of θ moved: J more")
