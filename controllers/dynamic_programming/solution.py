"""The optimal policy on a grid by Howard's policy iteration, with bounds and a certificate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from controllers.dynamic_programming.bellman import (
    Accuracy,
    BellmanOperator,
    Elementwise,
    accurate_substeps,
)
from controllers.dynamic_programming.grid import Grid, Indices, graded_axis
from controllers.dynamic_programming.minimisation import nelder_mead, scan
from controllers.errors import OptimumError
from controllers.model import economic_cost
from controllers.problem import PlantProblem, Problem
from cosim.core.protocols import Array


@dataclass(frozen=True)
class Settings:
    """Settings of the solver.

    `level` 0 is a first grid over all states. Each further level resolves the closed loop's support
    (all but `tail` of the samples at each end) with `cells`·2^level cells a state; cells beyond it
    grow by `growth` each. `nodes` and `penalty_nodes` are per disturbance; empty: 7 and 20 for the
    first two, 2 and 4 for the third, 2 and 2 for the others. `integration_tolerance` of the sampled
    model and `tolerance` of the distance of the gain's bounds are relative; the latter is to be met
    within `rounds` policy iterations a grid.
    """

    level: int = 1
    cells: int = 12
    growth: float = 1.35
    tail: float = 1e-7
    nodes: tuple[int, ...] = ()
    penalty_nodes: tuple[int, ...] = ()
    integration_tolerance: float = 1e-6
    tolerance: float = 1e-4
    rounds: int = 40

    def accuracy(self, plant: PlantProblem) -> Accuracy:
        """Integrator and quadrature for a problem."""
        # The first two disturbances move the state most.
        count = len(plant.law.nominal)
        others = (2,) * count
        nodes = (7, 7, *others)[:count]
        penalty_nodes = (20, 20, 4, *others)[:count]
        return Accuracy(
            substeps=accurate_substeps(plant, self.integration_tolerance),
            nodes=self.nodes or nodes,
            penalty_nodes=self.penalty_nodes or penalty_nodes,
        )


def first_grid(
    problem: Problem,
    operator: BellmanOperator,
    settings: Settings,
) -> Grid:
    """Grid over all states within the bounds and a tenth beyond.

    At the reference and at the bounds, where the optimal closed loop may live, its cells are half a
    standard deviation of one sample's disturbance wide.

    Args:
        problem: The problem with its bounds and reference.
        operator: The Bellman operator, which knows the disturbance's effect on a state.
        settings: The solver's settings.
    """
    deviation = operator.deviation(problem.reference_state, problem.reference_action)
    axes = []
    for i in range(problem.n_states):
        lower = problem.state_lower[i]
        upper = problem.state_upper[i]
        reference = problem.reference_state[i]
        span = upper - lower
        spacing = max(0.5 * deviation[i], 1e-3 * span)
        features = []
        for x in (lower, reference, upper):
            features.append((x - spacing, x + spacing, spacing))
        # Beyond the bounds, which are soft: the closed loop may violate them.
        first = lower - 0.1 * span
        last = upper + 0.1 * span
        marks = sorted({first, lower, reference, upper, last})
        # A start may be coarse: a cell is as much wider as two cells of later grids make.
        growth = settings.growth**2
        axes.append(graded_axis(marks, features, growth))
    return Grid(tuple(axes))


def refined(
    operator: BellmanOperator,
    optimum: Optimum,
    settings: Settings,
    level: int,
    *,
    smooth: bool = True,
) -> Optimum:
    """A policy on a grid that resolves its distribution's support with cells·2^level cells a state.

    At a bound that the closed loop touches the cells are 2^-level of the standard deviation of one
    sample's disturbance, which alone smooths the penalty's kink. The grid extends beyond the
    support by the support's width, and at least by a twentieth of the bounds' span; without
    disturbance it keeps its box.

    Args:
        operator: The Bellman operator.
        optimum: The policy on a coarser grid, with its stationary distribution.
        settings: The solver's settings.
        level: The new grid's level.
        smooth: Whether interpolation is cubic within the support.

    Returns:
        The policy, interpolated linearly, with its value on the new grid.
    """
    problem = operator.problem
    n = problem.n_states
    grid = optimum.grid

    # The disturbance's effect on a sample, at the mean of state and action in the closed loop.
    mass = np.maximum(optimum.distribution, 0.0)
    points = np.column_stack([grid.points, optimum.actions])
    mean = mass @ points / mass.sum()
    mean_state = mean[:n]
    mean_action = mean[n:]
    deviation = operator.deviation(mean_state, mean_action)

    mass_on_grid = mass.reshape(grid.shape)
    axes = []
    intervals = []
    for i, axis in enumerate(grid.axes):
        other_axes = [j for j in range(n) if j != i]
        marginal = mass_on_grid.sum(axis=tuple(other_axes))
        support = _support(axis, marginal, settings.tail)
        finer_axis = _refined_axis(
            operator,
            settings,
            level,
            i,
            axis,
            support,
            deviation[i],
        )
        axes.append(finer_axis)
        # Beyond a bound the value has a kink wherever the return takes one more sample.
        first = max(support[0], problem.state_lower[i])
        last = min(support[1], problem.state_upper[i])
        intervals.append((first, last))
    finer = Grid(tuple(axes), tuple(intervals) if smooth else None)

    # Linear: a policy has kinks where an action meets its bound, at which a cubic overshoots.
    states = list(finer.points.T)
    linear = Grid(grid.axes)
    columns = []
    for action in optimum.actions.T:
        interpolated = linear.interpolant(action)
        columns.append(interpolated(states))
    actions = np.stack(columns, axis=1)
    return start_policy(operator, finer, actions, share=0.1)


def _support(
    axis: Array,
    mass: Array,
    tail: float,
) -> tuple[float, float]:
    """Interval that holds all but `tail` of the mass at each end, and a cell on either side."""
    # A cell more on either side: the mass stands at points for what is between them.
    cumulative = np.cumsum(mass) / mass.sum()
    begin, end = np.searchsorted(cumulative, (tail, 1.0 - tail))
    last_point = len(axis) - 1
    first = max(begin - 1, 0)
    last = min(end + 1, last_point)
    return axis[first], axis[last]


def _refined_axis(
    operator: BellmanOperator,
    settings: Settings,
    level: int,
    i: int,
    axis: Array,
    support: tuple[float, float],
    deviation: float,
) -> Array:
    """Axis of state i on a grid of `level`; `deviation` is that of a sample's disturbance in it."""
    problem = operator.problem
    reference = problem.reference_state[i]
    lower = problem.state_lower[i]
    upper = problem.state_upper[i]
    span = upper - lower
    first, last = support
    width = last - first

    # Dense within the support, and about each bound that the closed loop touches.
    refinement = 2**level
    n_cells = settings.cells * refinement
    features = [(first, last, width / n_cells)]
    marks = {reference}
    near = max(deviation, 1e-3 * span)
    for bound in (lower, upper):
        is_touched = first - deviation <= bound <= last + deviation
        if is_touched:
            marks.add(bound)
            about_bound = (bound - near, bound + near, near / refinement)
            features.append(about_bound)

    # Without disturbance a state that strays never comes into the support's mass: keep the box.
    share = 1.0 if operator.deterministic else 0.05
    beyond = max(width, share * span)
    wanted_low = min(first, reference) - beyond
    wanted_high = max(last, reference) + beyond
    low = max(axis[0], wanted_low)
    high = min(axis[-1], wanted_high)
    inner_marks = [x for x in sorted(marks) if low < x < high]
    return graded_axis([low, *inner_marks, high], features, settings.growth)


RESTART_PROBABILITY = 1e-9
"""Probability that a sample starts anew at the anchor: so a plant without disturbance, which may
come to rest in several places, has one gain. It shifts J* by 1e-10 of itself."""


LARGEST_GRID = 200_000
"""States of a grid beyond which the factorisation of a policy takes hours and many gigabytes."""


class GainEstimate(NamedTuple):
    """An estimate of J*: how it was made, its value and interval [lower, upper]."""

    name: str
    value: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Optimum:
    """A policy on a grid with its value, in the end the optimal one.

    `actions` (G, m); `W` (G,) smooth part of the value, V = penalty + W, zero at the anchor;
    `gain` mean cost per sample, in the end J*; `distribution` (G,) the stationary one. `lower` and
    `upper`, min and max over the grid of TW − W, enclose the optimal gain (Odoni, 1969).
    `certificate` is that of `certify`, `step` (G, m) the last change of the actions.
    """

    grid: Grid
    actions: Array
    W: Array
    gain: float
    distribution: Array
    accuracy: Accuracy
    lower: float = -np.inf
    upper: float = np.inf
    certificate: tuple[GainEstimate, ...] = ()
    step: Array = field(default_factory=partial(np.zeros, 0))

    @property
    def edge_mass(self) -> float:
        """Share of samples that the closed loop spends on the edge of the grid's box."""
        grid = self.grid
        on_edge = np.zeros(grid.size, dtype=bool)
        for axis, x in zip(grid.axes, grid.points.T, strict=True):
            on_edge |= x == axis[0]
            on_edge |= x == axis[-1]
        mass_on_edge = self.distribution[on_edge]
        return float(mass_on_edge.sum())


def evaluate_policy(
    operator: BellmanOperator,
    grid: Grid,
    actions: Array,
    anchor: int,
) -> tuple[Array, float, Array]:
    """Value, gain and stationary distribution of a policy.

    W + g = c + P W with W[anchor] = 0, by one sparse factorisation.

    Args:
        operator: The Bellman operator, which makes the chain P and the cost c.
        grid: The grid.
        actions: The policy, (G, m).
        anchor: Index of the grid state whose value is zero.

    Returns:
        The smooth part W of the value (G,), the gain, and the distribution (G,).

    Raises:
        OptimumError: The chain cannot be evaluated, or the grid has too many states for it.
    """
    if grid.size > LARGEST_GRID:
        sizes = [str(count) for count in grid.shape]
        raise OptimumError(
            f"there is no J* of this scenario: its {len(sizes)} states need a grid of "
            f"{' × '.join(sizes)} = {grid.size} points, and {LARGEST_GRID} can be solved; compare "
            "with the best θ of a search on the plant"
        )
    from scipy import sparse  # noqa: PLC0415
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    # [I − P  1; e_anchorᵀ  0] (W, g) = (c, 0).
    transition, cost = operator.chain(actions, grid)
    size = grid.size
    place_of_anchor = ([0], [anchor])
    unit = sparse.csr_array(([1.0], place_of_anchor), shape=(1, size))
    flow = sparse.eye_array(size) - (1.0 - RESTART_PROBABILITY) * transition
    ones = np.ones((size, 1))
    blocks = [[flow, ones], [unit, None]]
    bordered = sparse.block_array(blocks, format="csc")
    try:
        factors = splu(bordered)
    except RuntimeError as error:
        raise OptimumError(f"policy evaluation on a grid of {size} states: {error}") from error
    solution = factors.solve(np.append(cost, 0.0))
    W = solution[:size]
    gain = float(solution[size])

    # The transposed system's last row makes the multipliers a distribution: they sum to 1.
    sum_is_one = np.append(np.zeros(size), 1.0)
    stationary = factors.solve(sum_is_one, trans="T")
    distribution = stationary[:size]
    return W, gain, distribution


def start_policy(
    operator: BellmanOperator,
    grid: Grid,
    actions: Array,
    share: float = 1.0,
) -> Optimum:
    """Evaluate a first policy; its `step` is a tenth of the action box times `share`.

    Args:
        operator: The Bellman operator.
        grid: The grid.
        actions: The policy, (G, m).
        share: How far the next improvement looks, as a share of a tenth of the action box.
    """
    problem = operator.problem
    # Values of a mean cost are known up to a constant: one state's is set to zero.
    anchor = grid.nearest(problem.reference_state)
    W, gain, distribution = evaluate_policy(operator, grid, actions, anchor)
    tenth = 0.1 * (problem.action_upper - problem.action_lower)
    tenth_everywhere = np.tile(tenth, (grid.size, 1))
    return Optimum(
        grid=grid,
        actions=actions,
        W=W,
        gain=gain,
        distribution=distribution,
        accuracy=operator.accuracy,
        step=share * tenth_everywhere,
    )


def improve_policy(
    operator: BellmanOperator,
    iterate: Optimum,
    scan_points: int,
) -> Optimum:
    """Improve the policy once and bound the remaining gain.

    Each state has a local search from its present action or from a better one of a scan over the
    box; `lower` is a bound if that finds the global minimum.

    Args:
        operator: The Bellman operator.
        iterate: The present policy with its value.
        scan_points: Number of actions per dimension that the scan tries.

    Returns:
        The improved actions with the value of the former ones and its bounds.
    """
    grid = iterate.grid
    lower = operator.problem.action_lower
    upper = operator.problem.action_upper

    def objective(rows: Indices, actions: Array) -> Array:
        states = grid.points[rows]
        return operator.values(states, actions, grid, iterate.W)

    start, _ = scan(objective, iterate.actions, lower, upper, scan_points)
    # A simplex twice as large as the last change of an action finds the next one.
    width = upper - lower
    wanted = 2.0 * np.abs(iterate.step)
    size = np.clip(wanted, 2e-3 * width, 0.1 * width)
    actions, values = nelder_mead(
        objective,
        start,
        size,
        lower,
        upper,
        iterations=30,
        precision=1e-8 * abs(iterate.gain),
    )
    # Odoni (1969): the least and the largest of TW − W enclose the optimal gain.
    residual = values - iterate.W
    return replace(
        iterate,
        actions=actions,
        step=actions - iterate.actions,
        lower=float(residual.min()),
        upper=float(residual.max()),
    )


RoundProgress = Callable[[int, int, Optimum], None]
"""Called with the grid's level, the round on it and its result."""


CERTIFICATE_TOLERANCE = 5e-4
"""Relative distance within which the estimates of a certificate must agree."""
REQUIRED_ESTIMATES = ("solution", "refinement", "simulation")
SEARCH = "policy search"
BURN_IN = 300
"""Samples of a simulated path before it counts."""


def objection(certificate: Sequence[GainEstimate]) -> str | None:
    """Why a certified solution may not be called J*, or None.

    All estimates but that of a policy search must agree within `CERTIFICATE_TOLERANCE`.
    """
    estimates = {estimate.name: estimate for estimate in certificate}
    missing = [name for name in REQUIRED_ESTIMATES if name not in estimates]
    if missing:
        return f"not made: {', '.join(missing)}"
    # A search has a bound from above alone: what it finds may be dearer, not cheaper.
    search = estimates.pop(SEARCH, None)
    percent = 100 * CERTIFICATE_TOLERANCE
    # The others have intervals on both sides: they must agree with each other.
    values = [estimate.value for estimate in estimates.values()]
    least = min(values)
    spread = (max(values) - least) / abs(least)
    if spread > CERTIFICATE_TOLERANCE:
        names = ", ".join(estimates)
        return f"{names} are {100 * spread:.3f} % apart, more than {percent:g} %"
    allowed = CERTIFICATE_TOLERANCE * abs(values[0])
    for estimate in estimates.values():
        if estimate.upper - estimate.lower > 2 * allowed:
            return f"the interval of the {estimate.name} is wider than {2 * allowed:.3g}"
    if search is None:
        return None
    if search.upper < estimates["refinement"].value - allowed:
        return (
            f"a policy search found {search.value:.2f}, more than {percent:g} % "
            "below the refinement"
        )
    return None


def solve(
    plant: PlantProblem,
    settings: Settings | None = None,
    *,
    workers: int = 2,
    progress: RoundProgress | None = None,
) -> Optimum:
    """Solve for the optimal policy of the stochastic plant by Howard's policy iteration.

    Args:
        plant: The plant's model with its law and parameters.
        settings: The solver's settings; the default ones where they are None.
        workers: Threads that share the states; results do not depend on their number.
        progress: Called after each round.

    Raises:
        OptimumError: The bounds do not close to 1 % of the gain, or the closed loop leaves the
            grid's box in more than one of 10⁴ samples.
    """
    settings = settings or Settings()
    accuracy = settings.accuracy(plant)
    draft = BellmanOperator(plant, accuracy.draft(), workers=workers)
    operator = BellmanOperator(plant, accuracy, workers=workers)
    iterate = draft_solution(draft, settings, progress)
    # All so far was a start; the solution is of the full accuracy.
    solution = _iterate(operator, iterate, settings.level, settings, progress)
    return _accepted(solution)


def draft_solution(
    draft: BellmanOperator,
    settings: Settings,
    progress: RoundProgress | None = None,
) -> Optimum:
    """A policy near the optimal one on the grid of the last level.

    Args:
        draft: The Bellman operator, of little accuracy.
        settings: The solver's settings.
        progress: Called after each round.
    """
    problem = draft.problem
    run = partial(_iterate, settings=settings, progress=progress)
    approach = partial(run, draft, scan_points=5, start_only=True)

    # From the constant policy u_s to a first policy on the coarse grid.
    grid = first_grid(problem, draft, settings)
    constant_policy = np.tile(problem.reference_action, (grid.size, 1))
    iterate = start_policy(draft, grid, constant_policy)
    iterate = approach(iterate, 0)

    # Linear interpolation is monotone, so it converges from any start; it smears the closed loop
    # over its cells, so the support is known only once these are fine.
    if settings.level:
        iterate = refined(draft, iterate, settings, 1, smooth=False)
        iterate = approach(iterate, 1)
    for level in range(1, settings.level + 1):
        iterate = refined(draft, iterate, settings, level)
        iterate = approach(iterate, level)

    # One round that looks for better actions in the whole action box.
    last_level = settings.level
    return run(draft, iterate, last_level, scan_points=9, rounds=1)


def _iterate(
    operator: BellmanOperator,
    iterate: Optimum,
    level: int,
    settings: Settings,
    progress: RoundProgress | None,
    *,
    scan_points: int = 3,
    rounds: int | None = None,
    start_only: bool = False,
) -> Optimum:
    """Improve and evaluate until the bounds meet or, where `start_only`, the gain rests."""
    grid = iterate.grid
    anchor = grid.nearest(operator.problem.reference_state)
    for k in range(rounds or settings.rounds):
        last_gain = iterate.gain
        better = improve_policy(operator, iterate, scan_points)
        W, gain, distribution = evaluate_policy(operator, grid, better.actions, anchor)
        iterate = replace(
            better,
            W=W,
            gain=gain,
            distribution=distribution,
            accuracy=operator.accuracy,
        )
        if progress is not None:
            progress(level, k, iterate)
        # A start is good enough once the gain rests; a solution has bounds that meet.
        if start_only:
            distance = last_gain - gain
            allowed = 1e-4 * abs(gain)
        else:
            distance = iterate.upper - iterate.lower
            allowed = settings.tolerance * abs(gain)
        if distance <= allowed:
            break
    return iterate


def _accepted(optimum: Optimum) -> Optimum:
    """The optimum with bounds about its gain; raises OptimumError where it is none (`solve`)."""
    gain = optimum.gain
    distance = optimum.upper - optimum.lower
    if distance > 0.01 * abs(gain):
        raise OptimumError(
            f"policy iteration: the bounds of the gain, {optimum.lower:.6g} and "
            f"{optimum.upper:.6g}, are more than 1 % apart; allow more rounds or another grid"
        )
    # Rounding may leave a probability below zero, and a bound on the gain's other side.
    accepted = replace(
        optimum,
        distribution=np.maximum(optimum.distribution, 0.0),
        lower=min(optimum.lower, gain),
        upper=max(optimum.upper, gain),
    )
    if accepted.edge_mass > 1e-4:
        raise OptimumError(
            f"the optimal closed loop is on the edge of the grid's box in "
            f"{100 * accepted.edge_mass:.3g} % of the samples; widen the state bounds"
        )
    return accepted


def simulate_policy(
    plant: PlantProblem,
    optimum: Optimum,
    *,
    paths: int = 2000,
    steps: int = 5000,
) -> tuple[float, float]:
    """Mean cost per sample of a solution's policy on the plant's model.

    The policy is interpolated as in `OptimalPolicy`. Each of the independent paths starts in a
    state drawn from the stationary distribution; its first 300 samples are left out.

    Args:
        plant: its model and the law of its disturbances.
        optimum: the solution.
        paths: how many, all at once.
        steps: samples of each path that count.

    Returns:
        The mean, and half its 95 % interval.
    """
    rng = np.random.default_rng(0)
    # Without the smooth parts: linear, as the policy is applied.
    grid = Grid(optimum.grid.axes)
    policy = [grid.interpolant(column) for column in optimum.actions.T]

    # The burn-in then only has to forget the grid.
    probabilities = optimum.distribution / optimum.distribution.sum()
    start = rng.choice(grid.size, paths, p=probabilities)
    return mean_cost_of_paths(
        plant,
        optimum.accuracy.substeps,
        grid.points[start],
        lambda number, x: [action(x) for action in policy],
        lambda number: plant.parameters,
        steps,
        rng,
    )


def mean_cost_of_paths(
    plant: PlantProblem,
    substeps: int,
    start: Array,
    actions: Callable[[int, list[Any]], list[Any]],
    parameters: Callable[[int], Array],
    steps: int,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Mean cost per sample of independent paths on a plant's model.

    The first `BURN_IN` samples of each path, with numbers below zero, are left out.

    Args:
        plant: its model and the law of its disturbances.
        substeps: of the integrator.
        start: state of each path, (P, n).
        actions: of a sample's number and the states, n arrays (P,); gives m arrays (P,).
        parameters: of the plant at a sample's number, (n_p,).
        steps: samples of each path that count.
        rng: draws the disturbances.

    Returns:
        The mean, and half its 95 % interval.
    """
    problem = plant.problem
    paths = len(start)
    step = Elementwise(plant.sampled(substeps))
    stage_cost = Elementwise(economic_cost(problem.model))
    # An array (P,) for each state, action and disturbance.
    x: list[Any] = list(start.T)
    total = np.zeros(paths)
    for number in range(-BURN_IN, steps):
        u = actions(number, x)
        p = parameters(number)
        d = list(plant.law.draw(rng, paths).T)
        if number >= 0:
            (cost,) = stage_cost(x, u, d, p)
            total += cost
            total += problem.penalty.along(np.stack(x, axis=1))
        # A state that depends on no other may be one number.
        x = [np.broadcast_to(state, paths) for state in step(x, u, d, p)]

    # Paths are independent, the samples of one are not: the interval is that of the paths' means.
    means = total / steps
    half_width = 1.96 * means.std(ddof=1) / np.sqrt(paths)
    return float(means.mean()), float(half_width)


def certify(
    plant: PlantProblem,
    settings: Settings,
    optimum: Optimum,
    *,
    paths: int = 2000,
    steps: int = 5000,
    progress: RoundProgress | None = None,
) -> Optimum:
    """The solution on the grid of the next level, started from a solution, with a certificate.

    Its estimates: `solution`, the gain and its bounds on the given grid; `refinement`, those on the
    next level; `simulation`, the mean cost of the refined policy on the plant's model, 95 %; where
    it is added, `policy search`, the best θ that a search found, on the same noise.

    Args:
        plant: The plant's model with its law and parameters.
        settings: The settings with which the solution was made.
        optimum: The solution.
        paths: Paths of the simulation.
        steps: Samples of each path.
        progress: Called after each round.

    Raises:
        OptimumError: As `solve` raises it.
    """
    operator = BellmanOperator(plant, optimum.accuracy, workers=2)
    level = settings.level + 1
    # At full accuracy from the start, since the solution is close by.
    start = refined(operator, optimum, settings, level)
    iterate = _iterate(operator, start, level, settings, progress)
    refinement = _accepted(iterate)
    mean, half_width = simulate_policy(plant, refinement, paths=paths, steps=steps)
    certificate = (
        GainEstimate("solution", optimum.gain, optimum.lower, optimum.upper),
        GainEstimate("refinement", refinement.gain, refinement.lower, refinement.upper),
        GainEstimate("simulation", mean, mean - half_width, mean + half_width),
    )
    return replace(refinement, certificate=certificate)
