"""States of runs: their density at a bound, and phase portraits with the policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from cosim.core.protocols import Array
from cosim.core.scenario import VIOLATING, Scenario
from cosim.core.trajectory import Trajectory
from cosim.figures import style
from cosim.figures.style import BOUND, DASHED, palette, shown_case

Policy = Callable[[Array], Array]
"""Action (m,) in a state (n,)."""
GRID = 13
"""Points of a phase portrait's arrows in each direction."""
BINS = 80
"""Bins of a density, at most."""
OUTERMOST = 0.001
"""Share of the samples that axes leave out at either end."""


# Densities


def density_figure(
    runs: Mapping[str, Trajectory],
    scenario: Scenario,
    width: float = style.SCREEN,
) -> Figure:
    """Density of the first state against its lower bound, a line for each controller.

    The bins are common and an edge lies on the bound, so that no bin mixes both sides; the axis
    leaves out the outermost 0.1 % of all samples. The legend gives the share that violates it.

    Args:
        runs: trajectory of each controller.
        scenario: of the plant.
        width: in inches.
    """
    state = scenario.plant.states[0]
    bound = float(scenario.state_lower[0])
    unit = _unit(runs, state)
    samples = {case: run[state] for case, run in runs.items()}
    edges, bin_width = _common_bins(list(samples.values()), bound)
    styles = palette(list(samples))
    with style.figure(3.2, width) as drawn:
        axes = drawn.subplots()
        for case, values in samples.items():
            color = styles[case].color
            # Not by `density=True`, which would leave out the samples outside of the bins.
            counts, _ = np.histogram(values, edges)
            density = counts / (len(values) * bin_width)
            violates = bound - values > VIOLATING
            percent = 100 * np.mean(violates)
            label = f"{shown_case(case)}: {percent:.1f} % below"
            # The area is faint, so that lines of several controllers can be seen through it.
            axes.stairs(density, edges, fill=True, alpha=0.12, color=color)
            axes.stairs(density, edges, color=color, linewidth=1.2, label=label)
        axes.axvline(
            bound,
            color=BOUND,
            linewidth=1.1,
            linestyle=DASHED,
            label="bound",
        )
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(style.label(state, unit))
        axes.set_ylabel(_density_label(unit))
        # Above the axes: within, it would hide a line.
        axes.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=2,
            borderaxespad=0.2,
        )
        style.ask(drawn, f"How often is {style.label(state, '')} below its bound?")
    return drawn


def _unit(runs: Mapping[str, Trajectory], signal: str) -> str:
    """Unit of a signal, which is the same in all runs."""
    first_run = next(iter(runs.values()))
    return first_run.signals[signal].unit


def _density_label(unit: str) -> str:
    """Label of a density over a quantity with a unit."""
    if unit in ("", "1"):
        return "density"
    # Without brackets 1/kg/min would read as a division by both.
    inverse = f"1/({unit})" if "/" in unit else f"1/{unit}"
    return f"density [{inverse}]"


def _common_bins(samples: Sequence[Array], bound: float) -> tuple[Array, float]:
    """Edges of bins for several histograms, of which one is `bound`, and the bins' width."""
    all_samples = np.concatenate(samples)
    lowest, highest = np.quantile(all_samples, (OUTERMOST, 1.0 - OUTERMOST))
    low = min(float(lowest), bound)
    high = max(float(highest), bound)
    width = (high - low) / BINS
    # Not narrower than the smallest sample can fill (Freedman and Diaconis' rule).
    for values in samples:
        lower_quartile, upper_quartile = np.quantile(values, (0.25, 0.75))
        quartile_range = float(upper_quartile - lower_quartile)
        n_samples = len(values)
        fillable = float(2 * quartile_range / np.cbrt(n_samples))
        width = max(width, fillable)
    # All samples may be one number.
    if not width:
        width = 1e-3 * max(abs(bound), 1.0)
    # Edges are whole widths from the bound, one bin more than needed on either side.
    below = np.ceil((bound - low) / width) + 1
    above = np.ceil((high - bound) / width) + 1
    numbers = np.arange(-below, above + 1)
    edges: Array = bound + width * numbers
    return edges, width


# Phase portraits


def phase_figure(
    runs: Mapping[str, Trajectory],
    policies: Mapping[str, Policy],
    scenario: Scenario,
) -> Figure:
    """Phase portraits, a panel for each controller: where the state lives, and its policy there.

    Background: density of the visited states, logarithmic. Arrows: the policy as a vector field,
    (π(s) − u_s)/(u_u − u_l), right where the first input rises and up where the second does; an
    arrow's length goes with the root of its size. Red: bounds. Cross: operating point.

    Args:
        runs: trajectory of each controller.
        policies: action (m,) of each controller in a state (n,).
        scenario: of the plant, with two states and two inputs.
    """
    x, y = _grid_of_states(list(runs.values()))
    fields = {case: _field(policy, x, y, scenario) for case, policy in policies.items()}
    # Arrows of all panels have one scale, so that policies can be compared.
    longest = _longest_arrow(list(fields.values()))
    # Policies that stay at the operating point have no arrows to scale.
    arrow_scale = longest or 1.0
    left, right = _limits_of_cells(x)
    bottom, top = _limits_of_cells(y)
    # Four panels make a square, not a row of three and one alone.
    columns = 2 if len(runs) == 4 else min(len(runs), 3)
    rows = -(-len(runs) // columns)
    height = 7.0 / columns * rows + 0.4
    # One panel across the page would be as high as a page.
    width = style.WIDTH if columns > 1 else 4.2
    first_state, second_state = scenario.plant.states[:2]
    across = style.label(first_state, _unit(runs, first_state))
    upright = style.label(second_state, _unit(runs, second_state))
    with style.figure(height, width) as drawn:
        grid = drawn.subplots(
            rows,
            columns,
            sharex=True,
            sharey=True,
            squeeze=False,
        )
        # The last row may have fewer panels.
        for axes in grid.flat[len(runs) :]:
            axes.set_visible(False)
        for axes, (case, run) in zip(grid.flat, runs.items(), strict=False):
            _draw_density(axes, run.states[:, :2], (left, right, bottom, top))
            _draw_arrows(axes, x, y, fields[case] / arrow_scale)
            _draw_operating_point(axes, scenario)
            _draw_bounds(axes, scenario)
            axes.set_title(shown_case(case))
            axes.set_xlim(left, right)
            axes.set_ylim(bottom, top)
        for axes in grid[-1]:
            axes.set_xlabel(across)
        for axes in grid[:, 0]:
            axes.set_ylabel(upright)
        style.ask(
            drawn,
            "Where does each controller keep the plant, and how does it act there?",
            _caption(scenario, longest),
        )
    return drawn


def _grid_of_states(runs: Sequence[Trajectory]) -> tuple[Array, Array]:
    """First and second states of a grid over what runs visited, (GRID,) each."""
    visited = np.concatenate([run.states for run in runs])
    low, high = np.quantile(visited, (OUTERMOST, 1.0 - OUTERMOST), axis=0)
    x = np.linspace(low[0], high[0], GRID)
    y = np.linspace(low[1], high[1], GRID)
    return x, y


def _limits_of_cells(points: Array) -> tuple[float, float]:
    """Limits of an axis that reaches half a cell beyond the outermost points, where arrows end."""
    first = float(points[0])
    last = float(points[-1])
    half = 0.5 * float(points[1] - points[0])
    return first - half, last + half


def _caption(scenario: Scenario, longest: float) -> str:
    """Legend of arrows, colours and lines; `longest` is the longest arrow, in input ranges."""
    first_action, second_action = scenario.plant.actions[:2]
    right = style.label(first_action, "")
    up = style.label(second_action, "")
    return (
        f"arrows: input less its operating point, right {right}, up {up}; the longest is "
        f"{100 * longest:.0f} % of the input range; colour: how often the state was there, "
        "logarithmic; red: bounds; cross: operating point"
    )


def _field(policy: Policy, x: Array, y: Array, scenario: Scenario) -> Array:
    """First two inputs of a policy less the operating point, in shares of their range.

    Args:
        policy: of the state, (n,).
        x: first state of the grid, (X,).
        y: second state of the grid, (Y,).
        scenario: of the plant, with two states.

    Returns:
        The field, (Y, X, 2).
    """
    actions = np.empty((len(y), len(x), 2))
    # State by state: a policy is a controller, and takes no batch.
    for row, second in enumerate(y):
        for column, first in enumerate(x):
            state = np.array([first, second])
            action = policy(state)
            actions[row, column] = action[:2]
    from_operating_point = actions - scenario.reference_action[:2]
    # Inputs of unlike units become comparable as shares of their range.
    input_range = scenario.action_upper - scenario.action_lower
    field: Array = from_operating_point / input_range[:2]
    return field


def _lengths(field: Array) -> Array:
    """Lengths (Y, X) of the arrows of a field (Y, X, 2)."""
    return np.hypot(field[..., 0], field[..., 1])


def _longest_arrow(fields: Sequence[Array]) -> float:
    """Largest length in fields (Y, X, 2); an action that is NaN has none."""
    longest = 0.0
    for field in fields:
        lengths = _lengths(field)
        longest = max(longest, float(np.nanmax(lengths)))
    return longest


def _draw_density(axes: Axes, states: Array, extent: tuple[float, float, float, float]) -> None:
    """Draw how often a run of states (K, 2) was where, within left, right, bottom and top."""
    left, right, bottom, top = extent
    x = states[:, 0]
    y = states[:, 1]
    # The axes leave out the outermost samples.
    inside_x = (x > left) & (x < right)
    inside_y = (y > bottom) & (y < top)
    inside = inside_x & inside_y
    cells = axes.hexbin(
        x[inside],
        y[inside],
        gridsize=40,
        extent=extent,
        mincnt=1,
        linewidths=0.1,
        zorder=1,
    )
    counts = cells.get_array()
    if counts is not None and counts.size:
        # The upper part of the map is left out: arrows must stay legible on it.
        cells.set(cmap="YlGnBu", norm=LogNorm(0.7, 20.0 * float(counts.max())))


def _draw_arrows(axes: Axes, x: Array, y: Array, field: Array) -> None:
    """Draw a field (Y, X, 2) on a grid as arrows, whose length goes with the root of its size."""
    size = _lengths(field)
    # An arrow without a length has no direction, and is not drawn.
    divisible = np.where(size > 0, size, 1.0)
    # Divided by the root of its size: else small arrows could not be seen beside large ones.
    shrink = 1.0 / np.sqrt(divisible)
    grid_x, grid_y = np.meshgrid(x, y)
    axes.quiver(
        grid_x,
        grid_y,
        field[..., 0] * shrink,
        field[..., 1] * shrink,
        # Directions are those of the inputs, not of points in the plane of the states.
        angles="uv",
        pivot="mid",
        scale=1.05 * max(len(x), len(y)),
        scale_units="width",
        width=0.004,
        color="#1A1A1A",
        zorder=4,
    )


def _draw_operating_point(axes: Axes, scenario: Scenario) -> None:
    """Draw the operating point of the first two states as a cross."""
    x, y = scenario.reference_state[:2]
    axes.plot(
        x,
        y,
        "+",
        color=BOUND,
        markersize=9,
        markeredgewidth=1.6,
        zorder=5,
    )


def _draw_bounds(axes: Axes, scenario: Scenario) -> None:
    """Draw the bounds of the first two states, across and upright."""
    look: dict[str, Any] = {
        "color": BOUND,
        "linewidth": 1.0,
        "linestyle": DASHED,
        "zorder": 3,
    }
    for bounds in (scenario.state_lower, scenario.state_upper):
        axes.axvline(bounds[0], **look)
        axes.axhline(bounds[1], **look)
