"""The optimal policy of a plant whose prices are periodic: an action and a value for each phase.

Value iteration goes backward over the period, W_k(s) = min_a E[ℓ_k(s, a, d) + penalty(s₊) +
W_{k+1}(s₊)], until a period adds the same cost to every state. Prices do not move the plant: where
an action leads, and which penalty it makes likely, is computed once, at the nodes of a polynomial
in the action for each state. A phase then takes a product with a sparse matrix and the minimum of
that polynomial.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.bellman import Accuracy, BellmanOperator
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.solution import (
    GainEstimate,
    Optimum,
    Settings,
    draft_solution,
    mean_cost_of_paths,
    refined,
)
from controllers.errors import OptimumError
from controllers.problem import PlantProblem
from cosim.core.protocols import Array

if TYPE_CHECKING:
    from scipy import sparse

ACTION_NODES = 7
"""Nodes of the polynomial in each action."""
DRAFT_NODES = 5
"""The same while boxes of actions are looked for."""
LATTICE_POINTS = 11
"""Points of an action's range at which the polynomials are compared."""
FIRST_REACH = 0.06
"""Half width of the first box of actions about the still plant's policy, as a share of the
actuators' range."""
WIDENING = 1.0
"""Growth on either side of a box whose edge is touched, as a share of its width."""
MARGIN = 0.25
"""What the last box of actions is wider than the policy of all phases, as a share of its range."""
LEAST_MARGIN = 0.01
"""The same at least, as a share of the actuators' range."""
EDGE = 0.98
"""|ξ| from which on an action lies on the edge of its box."""
TOUCHING = 0.02
"""Share of phases and states that may lie on the edges of a box: those about a price's step."""
MOST_BOXES = 8
"""Boxes that are tried before a policy that still lies on their edge is refused."""
MOST_PERIODS = 20
"""Periods of value iteration on one box."""

StepProgress = Callable[[str], None]
"""Called with what has been done, in words."""


class PeriodicPlant(NamedTuple):
    """A plant whose prices are periodic.

    Attributes:
        plant: as it is without its signals.
        parameters: of the plant at each phase, (P, n_p); none of them moves its dynamics.
    """

    plant: PlantProblem
    parameters: Array

    @property
    def period(self) -> int:
        """Samples P of a period."""
        return len(self.parameters)


@dataclass(frozen=True)
class PeriodicOptimum:
    """A policy on a grid for each phase, and its value.

    Attributes:
        grid: of the states.
        actions: of each phase and grid state, (P, G, m).
        W: smooth part of the differential value, (P, G).
        gain: mean cost per sample over a period.
        lower, upper: least and largest mean cost that a period of value iteration adds to any
            grid state; they enclose the optimal gain (Odoni 1969, of the operator of a period).
        accuracy: of integrator and quadrature.
        certificate: estimates of the gain, as those of `Optimum`.
    """

    grid: Grid
    actions: Array
    W: Array
    gain: float
    lower: float
    upper: float
    accuracy: Accuracy
    certificate: tuple[GainEstimate, ...] = ()


class ActionBoxes(NamedTuple):
    """The box of actions of each grid state in which a polynomial stands for Q.

    Attributes:
        lower, upper: (G, m) each.
    """

    lower: Array
    upper: Array

    def points(self, xi: Array) -> Array:
        """Actions (G, m) at coordinates ξ in [−1, 1]^m, (G, m) or (m,)."""
        share = 0.5 * (1.0 + xi)
        return self.lower + share * (self.upper - self.lower)


class Nodes(NamedTuple):
    """Costs and next states at the nodes of the boxes: r^m for each state.

    Attributes:
        transition: weights of the grid's states, (r^m · G, G).
        costs: E[ℓ + penalty(s₊)] for each of the distinct prices, (J, r^m, G).
        price_of_phase: which of these a phase has, (P,).
        n_actions: m.
    """

    transition: sparse.csr_array
    costs: Array
    price_of_phase: NDArray[np.intp]
    n_actions: int


def chebyshev_nodes(count: int) -> Array:
    """The extrema of a Chebyshev polynomial on [−1, 1], its ends among them, (count,)."""
    angles = np.linspace(np.pi, 0.0, count)
    return np.cos(angles)


def lagrange_weights(nodes: Array, x: Array) -> Array:
    """Values of the Lagrange polynomials of nodes (r,) at points x (…), (…, r)."""
    weights = np.ones((*x.shape, len(nodes)))
    for j, k in itertools.permutations(range(len(nodes)), 2):
        weights[..., j] *= (x - nodes[k]) / (nodes[j] - nodes[k])
    return weights


def minimise_polynomials(values: Array, n_actions: int) -> tuple[Array, Array]:
    """Minimise polynomials on [−1, 1]^m that are given at the products of Chebyshev nodes.

    Their least values on a lattice, less what a parabola through a point's neighbours gains in each
    action.

    Args:
        values: of B polynomials, the last action running fastest, (r^m, B).
        n_actions: m.

    Returns:
        Minimisers (B, m), and the least values, (B,).
    """
    n_nodes = round(len(values) ** (1 / n_actions))
    lattice = np.linspace(-1.0, 1.0, LATTICE_POINTS)
    weights = lagrange_weights(chebyshev_nodes(n_nodes), lattice)
    all_weights: Array = weights
    for _ in range(n_actions - 1):
        all_weights = np.kron(all_weights, weights).astype(np.float64)
    on_lattice = all_weights @ values
    columns = np.arange(values.shape[1])
    place = on_lattice.argmin(axis=0)
    lowest = on_lattice[place, columns]
    least = lowest.copy()
    minimisers = np.empty((len(columns), n_actions))
    spacing = lattice[1] - lattice[0]
    shape = (LATTICE_POINTS,) * n_actions
    for i, index in enumerate(np.unravel_index(place, shape)):
        # At the end of the lattice the parabola is that about the next point.
        centre = np.clip(index, 1, LATTICE_POINTS - 2)
        stride = LATTICE_POINTS ** (n_actions - 1 - i)
        middle = place + (centre - index) * stride
        before = on_lattice[middle - stride, columns]
        after = on_lattice[middle + stride, columns]
        slope = 0.5 * (after - before)
        curvature = after + before - 2 * on_lattice[middle, columns]
        # A polynomial that is not convex there has its least value on the lattice.
        is_convex = curvature > 0
        vertex = np.clip(-slope / np.where(is_convex, curvature, 1.0), -1.0, 1.0)
        at_lattice = index - centre
        offset = np.where(is_convex, vertex, at_lattice)
        least += slope * (offset - at_lattice)
        least += 0.5 * curvature * (offset**2 - at_lattice**2)
        minimisers[:, i] = lattice[centre] + spacing * offset
    return minimisers, least


def node_costs(
    periodic: PeriodicPlant,
    operator: BellmanOperator,
    grid: Grid,
    boxes: ActionBoxes,
    n_nodes: int,
) -> Nodes:
    """Costs and next states at the nodes of the boxes.

    Args:
        periodic: The plant.
        operator: Its Bellman operator.
        grid: The grid.
        boxes: Of its states.
        n_nodes: Of the polynomial in each action.
    """
    from scipy import sparse  # noqa: PLC0415 - a stored optimum is read without it

    n_actions = boxes.lower.shape[1]
    nodes = chebyshev_nodes(n_nodes)
    prices, price_of_phase = np.unique(periodic.parameters, axis=0, return_inverse=True)
    matrices = []
    costs = np.empty((len(prices), len(nodes) ** n_actions, grid.size))
    for number, node in enumerate(itertools.product(nodes, repeat=n_actions)):
        actions = boxes.points(np.array(node))
        matrix, penalty = operator.transitions(grid.points, actions, grid)
        matrices.append(matrix)
        for j, parameters in enumerate(prices):
            costs[j, number] = operator.stage_costs(grid.points, actions, parameters) + penalty
    transition = sparse.vstack(matrices, format="csr")
    return Nodes(transition, costs, price_of_phase.reshape(-1), n_actions)


class _Sweep(NamedTuple):
    """A period of value iteration.

    Attributes:
        W: values before each phase, the sweep's own start behind them, (P+1, G); not normalised.
        xi: minimisers in the boxes, (P, G, m).
    """

    W: Array
    xi: Array

    @property
    def added(self) -> Array:
        """Mean cost per sample that the period adds to each grid state, (G,)."""
        return np.asarray((self.W[0] - self.W[-1]) / len(self.xi))

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest of these."""
        return float(self.added.min()), float(self.added.max())


def _sweep(nodes: Nodes, W: Array) -> _Sweep:
    """Value iteration backward over a period, from the values W (G,) at its end."""
    period = len(nodes.price_of_phase)
    n_actions = nodes.n_actions
    values = np.empty((period + 1, W.size))
    values[period] = W
    xi = np.empty((period, W.size, n_actions))
    for k in reversed(range(period)):
        to_go = nodes.transition @ values[k + 1]
        costs = nodes.costs[nodes.price_of_phase[k]]
        Q = costs + to_go.reshape(costs.shape)
        xi[k], values[k] = minimise_polynomials(Q, n_actions)
    return _Sweep(values, xi)


def solve_periodic(
    periodic: PeriodicPlant,
    settings: Settings | None = None,
    *,
    workers: int = 2,
    progress: StepProgress | None = None,
) -> PeriodicOptimum:
    """Solve for the optimal policy of each phase.

    The still plant at the mean prices gives the grid, the first values, and the first boxes.

    Args:
        periodic: The plant.
        settings: Of the still plant's solver; the default ones where they are None.
        workers: Threads that share the states; results do not depend on their number.
        progress: Called after each step.

    Raises:
        OptimumError: The bounds do not close to 0.1 % of the gain, or the policy lies on the edge
            of every box that was tried.
    """
    settings = settings or Settings()
    mean = replace(periodic.plant, parameters=periodic.parameters.mean(axis=0))
    accuracy = settings.accuracy(mean)
    still = draft_solution(BellmanOperator(mean, accuracy.draft(), workers=workers), settings)
    _tell(progress, f"still plant at the mean prices: about {still.gain:.1f}")
    draft = BellmanOperator(periodic.plant, accuracy.draft(), workers=workers)
    boxes, W = _find_boxes(periodic, draft, still, progress)
    operator = BellmanOperator(periodic.plant, accuracy, workers=workers)
    solution = _solved(periodic, operator, still.grid, W, boxes, settings)
    _tell(progress, f"{solution.lower:.3f} ≤ J* ≤ {solution.upper:.3f}")
    return solution


def _find_boxes(
    periodic: PeriodicPlant,
    draft: BellmanOperator,
    still: Optimum,
    progress: StepProgress | None,
) -> tuple[ActionBoxes, Array]:
    """Boxes of actions that hold the policy of all phases, and values (G,) at a period's begin.

    A period of value iteration each, of little accuracy, on boxes that grow where it touches them.

    Args:
        periodic: The plant.
        draft: Its Bellman operator, of little accuracy.
        still: Policy and values of the still plant, on the grid.
        progress: Called after each step.
    """
    grid = still.grid
    inside = _inside(grid)
    reach = FIRST_REACH * _actuator_range(periodic)
    # Where no sample is, the still plant's policy does.
    margin = np.where(inside[:, None], reach, 0.1 * reach)
    boxes = _within_actuators(periodic, still.actions - margin, still.actions + margin)
    W = still.W
    for number in range(MOST_BOXES):
        sweep = _sweep(node_costs(periodic, draft, grid, boxes, DRAFT_NODES), W)
        W = sweep.W[0] - sweep.W[0].min()
        lower, upper = sweep.bounds
        _tell(progress, f"actions {number}: J between {lower:.1f} and {upper:.1f}")
        wider = _widened(periodic, boxes, sweep.xi, inside)
        if wider is None:
            return _tightened(periodic, boxes, sweep.xi, inside), W
        boxes = wider
    raise OptimumError(
        f"the optimal policy of the period lies on the edge of {MOST_BOXES} boxes of actions"
    )


def _solved(
    periodic: PeriodicPlant,
    operator: BellmanOperator,
    grid: Grid,
    W: Array,
    boxes: ActionBoxes,
    settings: Settings,
) -> PeriodicOptimum:
    """The solution on a grid and in boxes of actions, from values W (G,)."""
    nodes = node_costs(periodic, operator, grid, boxes, ACTION_NODES)
    sweep = _converged(nodes, W, settings.tolerance, MOST_PERIODS)
    return _from_sweep(periodic, operator, grid, sweep, boxes.points(sweep.xi))


def _converged(nodes: Nodes, W: Array, tolerance: float, most: int) -> _Sweep:
    """The last of at most so many periods of value iteration, which end where the bounds meet."""
    for _ in range(most):
        sweep = _sweep(nodes, W)
        W = sweep.W[0] - sweep.W[0].min()
        lower, upper = sweep.bounds
        if upper - lower <= tolerance * abs(lower):
            break
    return sweep


def _inside(grid: Grid) -> NDArray[np.bool_]:
    """Which grid states lie in the closed loop's support, (G,)."""
    inside = np.ones(grid.size, dtype=bool)
    for x, (first, last) in zip(grid.points.T, grid.smooth or (), strict=True):
        inside &= (x >= first) & (x <= last)
    return inside


def _widened(
    periodic: PeriodicPlant,
    boxes: ActionBoxes,
    xi: Array,
    inside: NDArray[np.bool_],
) -> ActionBoxes | None:
    """Boxes that reach further where the policy lies on their edges; None where it does not.

    Outside of the support, where no sample is, a kink of the penalty could mislead a polynomial on
    a wide box: there the boxes stay as narrow as they are.

    Args:
        periodic: The plant.
        boxes: Of the sweep.
        xi: Its minimisers in them, (P, G, m).
        inside: Which grid states are in the support, (G,).
    """
    problem = periodic.plant.problem
    at_support = xi[:, inside]
    width = boxes.upper - boxes.lower
    lower = boxes.lower.copy()
    upper = boxes.upper.copy()
    grown = False
    for i in range(width.shape[1]):
        growth = np.where(inside, WIDENING * width[:, i], 0.0)
        # An actuator's bound is the edge of every box.
        has_room_below = boxes.lower[inside, i] > problem.action_lower[i]
        has_room_above = boxes.upper[inside, i] < problem.action_upper[i]
        touches_lower = (at_support[..., i] < -EDGE) & has_room_below
        touches_upper = (at_support[..., i] > EDGE) & has_room_above
        if touches_lower.mean() > TOUCHING:
            lower[:, i] -= growth
            grown = True
        if touches_upper.mean() > TOUCHING:
            upper[:, i] += growth
            grown = True
    if not grown:
        return None
    return _within_actuators(periodic, lower, upper)


def _tightened(
    periodic: PeriodicPlant,
    boxes: ActionBoxes,
    xi: Array,
    inside: NDArray[np.bool_],
) -> ActionBoxes:
    """Boxes a margin wider than the policy of all phases, where a polynomial is exact.

    A policy of few phases, such as that of the minutes about a price's step, may lie beyond.

    Args:
        periodic: The plant.
        boxes: Of the sweep.
        xi: Its minimisers in them, (P, G, m).
        inside: Which grid states are in the support, (G,).
    """
    actions = boxes.points(xi)
    tail = TOUCHING / 4
    least, most = np.quantile(actions[:, inside], (tail, 1 - tail), axis=0)
    margin = np.maximum(MARGIN * (most - least), LEAST_MARGIN * _actuator_range(periodic))
    lower = boxes.lower.copy()
    upper = boxes.upper.copy()
    lower[inside] = least - margin
    upper[inside] = most + margin
    return _within_actuators(periodic, lower, upper)


def _from_sweep(
    periodic: PeriodicPlant,
    operator: BellmanOperator,
    grid: Grid,
    sweep: _Sweep,
    actions: Array,
) -> PeriodicOptimum:
    """The optimum of a last sweep; raises OptimumError where its bounds are apart."""
    anchor = grid.nearest(operator.problem.reference_state)
    gain = float(sweep.added[anchor])
    lower, upper = sweep.bounds
    if upper - lower > 1e-3 * abs(gain):
        raise OptimumError(
            f"value iteration over periods: the bounds of the gain, {lower:.6g} and {upper:.6g}, "
            "are more than 0.1 % apart"
        )
    # Differential values: without the mean cost of the samples to the period's end.
    to_end = periodic.period - np.arange(periodic.period)
    W = sweep.W[:-1] - gain * to_end[:, None]
    W = W - W[0, anchor]
    return PeriodicOptimum(grid, actions, W, gain, lower, upper, operator.accuracy)


def _actuator_range(periodic: PeriodicPlant) -> Array:
    """Width of the actuators' box, (m,)."""
    problem = periodic.plant.problem
    return np.asarray(problem.action_upper - problem.action_lower)


def _within_actuators(periodic: PeriodicPlant, lower: Array, upper: Array) -> ActionBoxes:
    """Boxes (G, m) each, cut to the actuators' box."""
    problem = periodic.plant.problem
    return ActionBoxes(
        np.clip(lower, problem.action_lower, problem.action_upper),
        np.clip(upper, problem.action_lower, problem.action_upper),
    )


def _tell(progress: StepProgress | None, words: str) -> None:
    """Say what has been done, where anybody asks."""
    if progress is not None:
        progress(words)


# the certificate ------------------------------------------------------------------------------


def certify_periodic(
    periodic: PeriodicPlant,
    settings: Settings,
    optimum: PeriodicOptimum,
    *,
    paths: int = 2000,
    periods: int = 3,
    progress: StepProgress | None = None,
) -> PeriodicOptimum:
    """A solution with a certificate; the policy stays the given one.

    Its estimates: `solution`, the gain and its bounds on the given grid; `refinement`, those on a
    grid of the next level; `simulation`, the mean cost of the policy on the plant's model, 95 %.

    Args:
        periodic: The plant.
        settings: The settings with which the solution was made.
        optimum: The solution.
        paths: Paths of the simulation.
        periods: Periods of each path.
        progress: Called after each step.
    """
    operator = BellmanOperator(periodic.plant, optimum.accuracy, workers=2)
    finer = _refinement(periodic, operator, optimum, settings)
    _tell(progress, f"refinement: {finer.lower:.3f} ≤ J* ≤ {finer.upper:.3f}")
    mean, half_width = simulate_periodic(periodic, optimum, paths=paths, periods=periods)
    _tell(progress, f"simulation: {mean:.3f} ± {half_width:.3f}")
    certificate = (
        GainEstimate("solution", optimum.gain, optimum.lower, optimum.upper),
        GainEstimate("refinement", finer.gain, finer.lower, finer.upper),
        GainEstimate("simulation", mean, mean - half_width, mean + half_width),
    )
    return replace(optimum, certificate=certificate)


def _refinement(
    periodic: PeriodicPlant,
    operator: BellmanOperator,
    optimum: PeriodicOptimum,
    settings: Settings,
) -> PeriodicOptimum:
    """The solution on the grid of the next level, from the coarser one's values and policies."""
    # The grid of the next level is that of the still plant, whose support it resolves.
    mean = replace(periodic.plant, parameters=periodic.parameters.mean(axis=0))
    still = BellmanOperator(mean, optimum.accuracy.draft(), workers=2)
    draft = draft_solution(still, settings)
    finer = refined(still, draft, settings, settings.level + 1)
    states = list(finer.grid.points.T)
    linear = Grid(optimum.grid.axes)
    least = _interpolated(linear, optimum.actions.min(axis=0), states)
    most = _interpolated(linear, optimum.actions.max(axis=0), states)
    margin = np.maximum(MARGIN * (most - least), LEAST_MARGIN * _actuator_range(periodic))
    boxes = _within_actuators(periodic, least - margin, most + margin)
    W = linear.interpolant(optimum.W[0])(states)
    return _solved(periodic, operator, finer.grid, W, boxes, settings)


def _interpolated(grid: Grid, values: Array, states: list[Array]) -> Array:
    """Columns of values (G, m) interpolated at states, (B, m)."""
    columns = [grid.interpolant(column)(states) for column in values.T]
    return np.stack(columns, axis=1)


def simulate_periodic(
    periodic: PeriodicPlant,
    optimum: PeriodicOptimum,
    *,
    paths: int = 2000,
    periods: int = 3,
) -> tuple[float, float]:
    """Mean cost per sample of a solution's policy on the plant's model.

    The policy is interpolated as it is applied. The paths start at the reference; what counts are
    whole periods.

    Args:
        periodic: The plant.
        optimum: The solution.
        paths: How many, all at once.
        periods: Of each path that count.

    Returns:
        The mean, and half its 95 % interval.
    """
    plant = periodic.plant
    linear = Grid(optimum.grid.axes)

    def actions(number: int, x: list[Any]) -> list[Any]:
        """Those of the phase, interpolated."""
        of_phase = optimum.actions[number % periodic.period]
        return list(_interpolated(linear, of_phase, x).T)

    return mean_cost_of_paths(
        plant,
        optimum.accuracy.substeps,
        np.tile(plant.problem.reference_state, (paths, 1)),
        actions,
        lambda number: periodic.parameters[number % periodic.period],
        periods * periodic.period,
        np.random.default_rng(0),
    )
