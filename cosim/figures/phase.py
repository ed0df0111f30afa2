"""Phase portraits: where the state lives, and what the policy does there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from cosim.figures.style import BOUND, WIDTH, figure, label, plain, save
from cosim.scenario import Scenario

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Portrait:
    """One controller's panel: its name, the states it visited (K, 2), and its policy on a grid.

    `actions` (ny, nx, 2) are π(s) at the grid of `plot_phase_portraits`, NaN where it has none.
    """

    name: str
    states: Array
    actions: Array


def policy_on_grid(policy: Callable[[Array], Array], x: Array, y: Array) -> Array:
    """Evaluate a policy s (2,) -> a (m,) at every (x_j, y_i); returns (len(y), len(x), m)."""
    return np.array([[policy(np.array([xj, yi])) for xj in x] for yi in y])


def plot_phase_portraits(
    portraits: Sequence[Portrait],
    x: Array,
    y: Array,
    scenario: Scenario,
    path: str | Path,
    *,
    units: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Draw a panel for each controller, all on the axes that the grid x (nx,), y (ny,) spans.

    Background: density of the visited states, logarithmic. Arrows: the policy as a vector field,
    (π(s) − u_s)/(u_u − u_l), to the right where the first input rises and upwards where the second
    does; an arrow's length goes with the root of its size. Red: bounds. Cross: operating point.
    """
    width = (scenario.action_upper - scenario.action_lower)[:2]
    fields = [(portrait.actions - scenario.reference_action[:2]) / width for portrait in portraits]
    longest = max(float(np.nanmax(np.hypot(f[..., 0], f[..., 1]))) for f in fields)
    columns = 2 if len(portraits) == 4 else min(len(portraits), 3)
    rows = -(-len(portraits) // columns)
    margins = 0.5 * (x[-1] - x[0]) / (len(x) - 1), 0.5 * (y[-1] - y[0]) / (len(y) - 1)
    extent = (x[0] - margins[0], x[-1] + margins[0], y[0] - margins[1], y[-1] + margins[1])
    with figure(7.0 / columns * rows + 0.4, WIDTH if columns > 1 else 4.2) as drawn:
        grid = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(portraits) :]:
            axes.set_visible(False)
        for axes, portrait, field in zip(grid.flat, portraits, fields, strict=False):
            _density(axes, portrait.states, extent)
            _arrows(axes, x, y, field / (longest or 1.0))
            axes.plot(*scenario.reference_state[:2], "+", color=BOUND, ms=9, mew=1.6, zorder=5)
            _bounds(axes, scenario)
            axes.set_title(plain(portrait.name))
            axes.set_xlim(extent[:2])
            axes.set_ylim(extent[2:])
        first, second = (label(name, "") for name in scenario.plant.actions[:2])
        for axes in grid[-1]:
            axes.set_xlabel(
                label(scenario.plant.states[0], units.get(scenario.plant.states[0], ""))
            )
        for axes in grid[:, 0]:
            axes.set_ylabel(
                label(scenario.plant.states[1], units.get(scenario.plant.states[1], ""))
            )
        drawn.supxlabel(
            f"arrows: input less its operating point, right {first}, up {second}; the longest is "
            f"{100 * longest:.0f} % of the input range\ncolour: how often the state was there, "
            "logarithmic; red: bounds; cross: operating point",
            fontsize=7.0,
        )
    return save(drawn, path)


def _arrows(axes: Axes, x: Array, y: Array, field: Array) -> None:
    size = np.hypot(field[..., 0], field[..., 1])
    shrink = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
    axes.quiver(
        *np.meshgrid(x, y),
        field[..., 0] * shrink,
        field[..., 1] * shrink,
        angles="uv",
        pivot="mid",
        scale=1.05 * max(len(x), len(y)),
        scale_units="width",
        width=0.004,
        color="#1A1A1A",
        zorder=4,
    )


def _density(axes: Axes, states: Array, extent: tuple[float, float, float, float]) -> None:
    left, right, bottom, top = extent
    inside = (states > (left, bottom)).all(axis=1) & (states < (right, top)).all(axis=1)
    cells = axes.hexbin(
        *states[inside].T, gridsize=40, extent=extent, mincnt=1, linewidths=0.1, zorder=1
    )
    counts = cells.get_array()
    if counts is not None and counts.size:
        # The upper part of the map is left out: arrows must stay legible on it.
        cells.set(cmap="YlGnBu", norm=LogNorm(0.7, 20.0 * float(counts.max())))


def _bounds(axes: Axes, scenario: Scenario) -> None:
    for draw, i in ((axes.axvline, 0), (axes.axhline, 1)):
        for bound in (scenario.state_lower[i], scenario.state_upper[i]):
            draw(bound, color=BOUND, linewidth=1.0, linestyle=(0, (4, 2)), zorder=3)
