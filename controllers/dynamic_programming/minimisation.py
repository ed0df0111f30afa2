"""Many small box-constrained minimisations at once, by search without derivatives."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Objective = Callable[[Rows, Array], Array]


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

    `objective(rows, points)` evaluates functions `rows` (r,) at points (r, m); `start` (B, m);
    `size` (B, m) is the first simplex's edge; a function is done when its simplex's values lie
    within `precision` of each other. Returns minimisers (B, m) and values (B,), never worse than
    the start. The simplex method of Nelder and Mead (1965) with its standard
    coefficients and projection on the box: it needs no derivative, which the expected penalty
    of a nearly deterministic plant lacks, and it follows the penalty's narrow, skew valley, where
    a search along the coordinates stalls. SciPy's one runs one problem at a time.
    """
    count, m = start.shape
    everyone = np.arange(count)
    vertices = np.repeat(np.clip(start, lower, upper)[:, None], m + 1, axis=1)
    for i in range(m):
        moved = vertices[:, i + 1, i] + size[:, i]
        inward = np.where(moved > upper[i], vertices[:, i + 1, i] - size[:, i], moved)
        vertices[:, i + 1, i] = np.clip(inward, lower[i], upper[i])
    values = np.stack([objective(everyone, vertices[:, i]) for i in range(m + 1)], axis=1)
    for _ in range(iterations):
        order = np.argsort(values, axis=1, kind="stable")
        values = np.take_along_axis(values, order, axis=1)
        vertices = np.take_along_axis(vertices, order[:, :, None], axis=1)
        rows = np.flatnonzero(values[:, -1] - values[:, 0] > precision)
        if not len(rows):
            break
        vertices[rows], values[rows] = _replace_worst(
            objective, rows, vertices[rows], values[rows], lower, upper
        )
    best = values.argmin(axis=1)
    return vertices[everyone, best], values[everyone, best]


def _replace_worst(
    objective: Objective, rows: Rows, vertices: Array, values: Array, lower: Array, upper: Array
) -> tuple[Array, Array]:
    """One step of the simplex method on the sorted simplices of functions `rows`."""
    centre = vertices[:, :-1].mean(axis=1)
    worst = vertices[:, -1].copy()
    candidate = np.clip(2.0 * centre - worst, lower, upper)
    reflected = objective(rows, candidate)
    best = reflected < values[:, 0]
    accepted = reflected < values[:, -2]
    # Expansion, outside contraction and inside contraction as multiples of centre − worst.
    factor = np.where(best, 2.0, np.where(reflected < values[:, -1], 0.5, -0.5))
    trial = np.clip(centre + factor[:, None] * (centre - worst), lower, upper)
    tried = np.flatnonzero(best | ~accepted)
    outcome = np.full(len(values), np.inf)
    if len(tried):
        outcome[tried] = objective(rows[tried], trial[tried])
    candidate = np.where((outcome < reflected)[:, None], trial, candidate)
    outcome = np.minimum(outcome, reflected)
    improved = outcome < values[:, -1]
    vertices[:, -1] = np.where(improved[:, None], candidate, worst)
    values[:, -1] = np.where(improved, outcome, values[:, -1])
    shrinking = np.flatnonzero(~improved)
    for i in range(1, vertices.shape[1]):
        if len(shrinking):
            vertices[shrinking, i] = 0.5 * (vertices[shrinking, 0] + vertices[shrinking, i])
            values[shrinking, i] = objective(rows[shrinking], vertices[shrinking, i])
    return vertices, values


def scan(
    objective: Objective, start: Array, lower: Array, upper: Array, points: int
) -> tuple[Array, Array]:
    """Best of `start` (B, m) and a grid of `points` per variable over the box, with its value."""
    everyone = np.arange(len(start))
    best, values = start.copy(), objective(everyone, start)
    axes = [np.linspace(low, high, points) for low, high in zip(lower, upper, strict=True)]
    for point in itertools.product(*axes):
        candidate = np.broadcast_to(point, start.shape)
        found = objective(everyone, candidate)
        better = found < values
        best[better], values[better] = np.array(point), found[better]
    return best, values
