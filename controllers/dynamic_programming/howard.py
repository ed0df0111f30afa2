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
    has more than one recurrent class, so that its mean cost depends on where it starts.
    """
    matrix, cost = operator.chain(actions, grid)
    size = grid.size
    unit = sparse.csr_array(([1.0], ([0], [anchor])), shape=(1, size))
    bordered = sparse.block_array(
        [[sparse.eye_array(size) - matrix, np.ones((size, 1))], [unit, None]], format="csc"
    )
    try:
        factors = splu(bordered)
    except RuntimeError as error:
        raise OptimumError(
            "policy evaluation: the Markov chain on the grid has more than one recurrent class; "
            "take a finer grid or a disturbance that reaches every state"
        ) from error
    stationary = factors.solve(np.append(np.zeros(size), 1.0), trans="T")
    # The transposed system's last row makes the multipliers a distribution: they sum to 1.
    distribution = stationary[:size]
    if operator.discount == 1.0:
        solution = factors.solve(np.append(cost, 0.0))
        return solution[:size], float(solution[size]), distribution
    W = splu((sparse.eye_array(size) - operator.discount * matrix).tocsc()).solve(cost)
    return W, float(distribution @ cost), distribution


def begin(operator: BellmanOperator, grid: Grid, actions: Array, anchor: int) -> Iterate:
    """Evaluate a first policy (G, m); its `step` is a tenth of the action box."""
    problem = operator.problem
    width = problem.action_upper - problem.action_lower
    W, gain, distribution = evaluate(operator, grid, actions, anchor)
    return Iterate(grid, actions, W, gain, distribution, np.tile(0.1 * width, (grid.size, 1)))


def improve(
    operator: BellmanOperator, iterate: Iterate, *, scan_points: int = 0, iterations: int = 25
) -> Iterate:
    """Improve the policy once and bound what is left to gain.

    A local search from the present action of each state; with `scan_points` > 0 from the best of
    that many actions per dimension over the whole box, which is what makes `lower` a bound.
    Returns the improved actions with the value of the former ones and the bounds of that.
    """
    problem, grid = operator.problem, iterate.grid
    lower, upper = problem.action_lower, problem.action_upper

    def objective(rows: NDArray[np.intp], actions: Array) -> Array:
        return operator.values(grid.points[rows], actions, grid, iterate.W)

    start = iterate.actions
    if scan_points:
        start, _ = scan(objective, start, lower, upper, scan_points)
    width = upper - lower
    size = np.clip(2.0 * np.abs(iterate.step), 2e-3 * width, 0.1 * width)
    actions, values = nelder_mead(objective, start, size, lower, upper, iterations)
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
    anchor: int,
    *,
    rounds: int,
    tolerance: float,
    scan_rounds: int = 0,
    scan_points: int = 5,
    progress: Callable[[Iterate, int], None] | None = None,
) -> Iterate:
    """Howard's policy iteration until the bounds are `tolerance`·|gain| apart.

    At most `rounds` rounds, the first `scan_rounds` of which search the whole action box.
    `progress` is called with each improved iterate and its round's number.
    """
    iterate = start
    for k in range(rounds):
        improved = improve(
            operator, iterate, scan_points=scan_points if k < scan_rounds else 0
        )
        W, gain, distribution = evaluate(operator, improved.grid, improved.actions, anchor)
        iterate = replace(improved, W=W, gain=gain, distribution=distribution)
        if progress is not None:
            progress(iterate, k)
        if k + 1 >= scan_rounds and iterate.spread <= tolerance * abs(gain):
            break
    return iterate
