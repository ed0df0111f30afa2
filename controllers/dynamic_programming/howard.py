"""Howard's policy iteration on a state grid, with bounds on what it finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from controllers.dynamic_programming.bellman import BellmanOperator
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.minimisation import nelder_mead, scan
from controllers.errors import OptimumError

Array = NDArray[np.float64]
# Each sample starts anew at the anchor with this probability, so that a plant without disturbance,
# which may come to rest in several places, still has one gain; it shifts J* by 1e-10 of itself.
_RESTART = 1e-9


@dataclass(frozen=True)
class Iterate:
    """A policy on a grid with its value, and what one more improvement found.

    `actions` (G, m); `W` (G,) smooth part of the value, V = penalty + W, zero at the grid's anchor
    for γ = 1; `gain` mean cost per sample of the policy; `lower` and `upper` are min and
    max over the grid of TW − W. For γ = 1 they enclose the optimal gain (Odoni, 1969); for γ < 1
    they enclose (1−γ)(V* − V) (MacQueen, 1966). `distribution` (G,) is the stationary one, `step`
    (G, m) the last change of the actions.
    """

    grid: Grid
    actions: Array
    W: Array
    gain: float
    distribution: Array
    step: Array
    lower: float = -np.inf
    upper: float = np.inf

    @property
    def spread(self) -> float:
        """Width of the enclosure, upper − lower."""
        return self.upper - self.lower


def evaluate(
    operator: BellmanOperator, grid: Grid, actions: Array, anchor: int
) -> tuple[Array, float, Array]:
    """Value W (G,), gain and stationary distribution (G,) of a policy (G, m).

    For γ = 1: W + g = c + P W with W[anchor] = 0; for γ < 1: W = c + γ P W, and the gain from the
    stationary distribution. One sparse factorisation each. Raises OptimumError where the chain
    cannot be evaluated.
    """
    matrix, cost = operator.chain(actions, grid)
    size = grid.size
    unit = sparse.csr_array(([1.0], ([0], [anchor])), shape=(1, size))
    flow = sparse.eye_array(size) - (1.0 - _RESTART) * matrix
    bordered = sparse.block_array([[flow, np.ones((size, 1))], [unit, None]], format="csc")
    try:
        factors = splu(bordered)
    except RuntimeError as error:
        raise OptimumError(f"policy evaluation on a grid of {size} states: {error}") from error
    stationary = factors.solve(np.append(np.zeros(size), 1.0), trans="T")
    # The transposed system's last row makes the multipliers a distribution: they sum to 1.
    distribution = stationary[:size]
    if operator.discount == 1.0:
        solution = factors.solve(np.append(cost, 0.0))
        return solution[:size], float(solution[size]), distribution
    W = splu((sparse.eye_array(size) - operator.discount * matrix).tocsc()).solve(cost)
    return W, float(distribution @ cost), distribution


def begin(operator: BellmanOperator, grid: Grid, actions: Array) -> Iterate:
    """Evaluate a first policy (G, m); its `step` is a tenth of the action box."""
    problem = operator.problem
    anchor = grid.nearest(problem.reference_state)
    width = problem.action_upper - problem.action_lower
    W, gain, distribution = evaluate(operator, grid, actions, anchor)
    return Iterate(grid, actions, W, gain, distribution, np.tile(0.1 * width, (grid.size, 1)))


def improve(
    operator: BellmanOperator, iterate: Iterate, scan_points: int, *, iterations: int = 30
) -> Iterate:
    """Improve the policy once and bound what is left to gain.

    A local search in each state from its present action or, where one is better, from one of
    `scan_points` actions per dimension over the box: `lower` is a bound as far as these find the
    global minimum. Returns the improved actions with the value of the former ones and its bounds.
    """
    problem, grid = operator.problem, iterate.grid
    lower, upper = problem.action_lower, problem.action_upper

    def objective(rows: NDArray[np.intp], actions: Array) -> Array:
        return operator.values(grid.points[rows], actions, grid, iterate.W)

    start, _ = scan(objective, iterate.actions, lower, upper, scan_points)
    width = upper - lower
    size = np.clip(2.0 * np.abs(iterate.step), 2e-3 * width, 0.1 * width)
    actions, values = nelder_mead(
        objective,
        start,
        size,
        lower,
        upper,
        iterations=iterations,
        precision=1e-8 * abs(iterate.gain),
    )
    residual = values - iterate.W
    return replace(
        iterate,
        actions=actions,
        step=actions - iterate.actions,
        lower=float(residual.min()),
        upper=float(residual.max()),
    )


def iterate_policy(
    operator: BellmanOperator,
    start: Iterate,
    *,
    rounds: int,
    scan_points: int,
    enough: Callable[[Iterate, Iterate], bool],
    report: Callable[[Iterate, int], None],
) -> Iterate:
    """Howard's policy iteration until `enough(before, after)`, at most `rounds` rounds.

    Each round scans `scan_points` actions per dimension and ends with a call of `report`.
    """
    iterate = start
    anchor = start.grid.nearest(operator.problem.reference_state)
    for k in range(rounds):
        before = iterate
        improved = improve(operator, before, scan_points)
        W, gain, distribution = evaluate(operator, improved.grid, improved.actions, anchor)
        iterate = replace(improved, W=W, gain=gain, distribution=distribution)
        report(iterate, k)
        if enough(before, iterate):
            break
    return iterate
