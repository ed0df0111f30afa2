"""Many small minimisations at once: of B functions of m variables in a box."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from controllers.dynamic_programming.grid import Indices
from cosim.core.protocols import Array

Objective = Callable[[Indices, Array], Array]


def nelder_mead(
    objective: Objective,
    start: Array,
    size: Array,
    lower: Array,
    upper: Array,
    *,
    iterations: int,
    precision: float,
) -> tuple[Array, Array]:
    """Minimise B functions of m variables in a box, each from its own start.

    Nelder and Mead (1965), projected on the box; SciPy's minimises one function at a time. The
    expected penalty of a nearly deterministic plant has no derivative.

    Args:
        objective: `objective(rows, points)` evaluates functions `rows` (r,) at points (r, m).
        start: Starts, (B, m).
        size: Edges of the first simplices, (B, m).
        lower: Lower bounds of the box, (m,).
        upper: Upper bounds, (m,).
        iterations: Most iterations.
        precision: A function is done when its simplex's values lie so close to each other.

    Returns:
        Minimisers (B, m) and values (B,), never worse than the start.
    """
    count, m = start.shape
    every_row = np.arange(count)
    vertices = _first_simplices(start, size, lower, upper)
    columns = []
    for i in range(m + 1):
        column = objective(every_row, vertices[:, i])
        columns.append(column)
    values = np.stack(columns, axis=1)

    for _ in range(iterations):
        # The best vertex first, the worst one last.
        order = np.argsort(values, axis=1, kind="stable")
        order_of_vertices = order[:, :, None]
        values = np.take_along_axis(values, order, axis=1)
        vertices = np.take_along_axis(vertices, order_of_vertices, axis=1)
        # Functions whose simplices lie flat are done: the others alone cost evaluations.
        spread = values[:, -1] - values[:, 0]
        rows = np.flatnonzero(spread > precision)
        if not len(rows):
            break
        present = values[rows]
        best = present[:, 0]
        second_worst = present[:, -2]
        worst = present[:, -1]

        # Reflect the worst vertex at the centre of the others.
        worst_vertex = vertices[rows, -1]
        others = vertices[rows, :-1]
        centre = others.mean(axis=1)
        candidate = np.clip(2.0 * centre - worst_vertex, lower, upper)
        reflected = objective(rows, candidate)
        is_best = reflected < best
        is_accepted = reflected < second_worst

        # Expansion, outside contraction and inside contraction as multiples of centre − worst.
        contraction = np.where(reflected < worst, 0.5, -0.5)
        factor = np.where(is_best, 2.0, contraction)
        direction = centre - worst_vertex
        trial = centre + factor[:, None] * direction
        trial = np.clip(trial, lower, upper)
        # A reflection that is accepted and not the best stands without a second point.
        tried = np.flatnonzero(is_best | ~is_accepted)
        outcome = np.full(len(rows), np.inf)
        if len(tried):
            tried_rows = rows[tried]
            outcome[tried] = objective(tried_rows, trial[tried])
        trial_is_better = outcome < reflected
        candidate[trial_is_better] = trial[trial_is_better]
        outcome = np.minimum(outcome, reflected)

        improved = outcome < worst
        improved_rows = rows[improved]
        vertices[improved_rows, -1] = candidate[improved]
        values[improved_rows, -1] = outcome[improved]
        # What no point improved shrinks towards its best vertex.
        shrinking = rows[~improved]
        if len(shrinking):
            _shrink(objective, shrinking, vertices, values)

    best_vertex = values.argmin(axis=1)
    minimisers = vertices[every_row, best_vertex]
    least_values = values[every_row, best_vertex]
    return minimisers, least_values


def _shrink(
    objective: Objective,
    rows: Indices,
    vertices: Array,
    values: Array,
) -> None:
    """Move the vertices of simplices halfway to their best one, in place.

    Args:
        objective: As `nelder_mead` takes it.
        rows: Numbers of these simplices.
        vertices: Those of all simplices, the best one first, (B, m+1, m).
        values: At the vertices, (B, m+1).
    """
    n_vertices = values.shape[1]
    best = vertices[rows, 0]
    for i in range(1, n_vertices):
        halfway = 0.5 * (best + vertices[rows, i])
        vertices[rows, i] = halfway
        values[rows, i] = objective(rows, halfway)


def _first_simplices(
    start: Array,
    size: Array,
    lower: Array,
    upper: Array,
) -> Array:
    """Vertices (B, m+1, m) of simplices with edges along the axes, within the box."""
    _, m = start.shape
    inside = np.clip(start, lower, upper)
    n_vertices = m + 1
    vertices = np.repeat(inside[:, None], n_vertices, axis=1)
    for i in range(m):
        # Vertex i+1 differs from the start in entry i, inwards where outwards leaves the box.
        entry = inside[:, i]
        edge = size[:, i]
        outward = entry + edge
        inward = entry - edge
        leaves = outward > upper[i]
        moved = np.where(leaves, inward, outward)
        vertices[:, i + 1, i] = np.clip(moved, lower[i], upper[i])
    return vertices


def scan(
    objective: Objective,
    start: Array,
    lower: Array,
    upper: Array,
    points: int,
) -> tuple[Array, Array]:
    """Best of a start and of a grid over the box, for B functions.

    Args:
        objective: As `nelder_mead` takes it.
        start: Starts, (B, m).
        lower: Lower bounds of the box, (m,).
        upper: Upper bounds, (m,).
        points: Number of the grid's points per variable.

    Returns:
        The best point (B, m) of each function, and its value (B,).
    """
    every_row = np.arange(len(start))
    # The start counts too: a scan makes nothing worse.
    best = start.copy()
    values = objective(every_row, start)
    axes = []
    for low, high in zip(lower, upper, strict=True):
        axes.append(np.linspace(low, high, points))
    for point in itertools.product(*axes):
        candidate = np.broadcast_to(point, start.shape)
        outcome = objective(every_row, candidate)
        better = outcome < values
        best[better] = np.array(point)
        values[better] = outcome[better]
    return best, values
