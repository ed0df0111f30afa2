"""The stochastic control problem solved by policy iteration, and what certifies the solution."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from controllers.dynamic_programming.bellman import (
    Accuracy,
    BellmanOperator,
    Elementwise,
    PlantProblem,
)
from controllers.dynamic_programming.grid import Grid
from controllers.errors import OptimumError
from controllers.model import discretise, economic_cost
from controllers.problem import Problem
from cosim.protocols import Array


@dataclass(frozen=True)
class Settings:
    """How the problem is solved.

    `level` 0 is a first grid over all states, each further level resolves the closed loop's support
    (all but `tail` of the samples at each end) with `cells`·2^level cells a state; cells beyond it
    grow by `growth` each. `nodes` and `penalty_nodes` per disturbance, the influential ones first;
    empty: 7 and 20 for the first two, 2 and 4 for the third, 2 and 2 for the others.
    `integration_tolerance` on the sampled model, relative; `tolerance` on the distance of the
    gain's bounds, relative, to be met within `rounds` policy iterations a grid.
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
        count = len(plant.law.nominal)
        return Accuracy(
            accurate_substeps(plant, self.integration_tolerance),
            self.nodes or (7, 7, *(2,) * count)[:count],
            self.penalty_nodes or (20, 20, 4, *(2,) * count)[:count],
        )


def accurate_substeps(plant: PlantProblem, tolerance: float) -> int:
    """Least power of two of RK4 substeps whose doubling moves no next state by more than allowed.

    Allowed is `tolerance`·(1 + |x|), tried at 2000 points: states within the first quarter of the
    bounds' box around the reference, actions in their box, disturbances of the law. Raises
    OptimumError where 128 substeps do not do.
    """
    problem, generator = plant.problem, np.random.default_rng(0)
    reach = 0.25 * (problem.state_upper - problem.state_lower)
    x = generator.uniform(
        np.maximum(problem.state_lower, problem.reference_state - reach),
        np.minimum(problem.state_upper, problem.reference_state + reach),
        (2000, problem.n_states),
    )
    u = generator.uniform(problem.action_lower, problem.action_upper, (2000, problem.n_actions))
    d = plant.law.draw(generator, 2000)
    before: Array | None = None
    for substeps in 2 ** np.arange(8):
        step = Elementwise(discretise(problem.model, problem.sampling_time, int(substeps)))
        # A step that is too long may overflow; then the next one is tried.
        with np.errstate(all="ignore"):
            entries = step(x.T, u.T, d.T, plant.parameters)
            x_next = np.stack([np.broadcast_to(entry, 2000) for entry in entries], axis=1)
            moved = np.inf if before is None else np.abs(x_next - before)
        if np.all(moved <= tolerance * (1 + np.abs(x))):
            return int(substeps)
        before = x_next
    raise OptimumError(
        f"model '{problem.model.name}': 128 RK4 substeps a sample do not integrate it to "
        f"{tolerance:g}; shorten the sampling time"
    )


Feature = tuple[float, float, float]
"""First and last point of an interval of an axis, and the width that its cells shall not exceed."""


def first_grid(problem: Problem, operator: BellmanOperator, settings: Settings) -> Grid:
    """Grid over all states within the bounds and a tenth beyond.

    Its cells are half a standard deviation of one sample's disturbance wide at the reference and
    at the bounds, where the optimal closed loop may live.
    """
    deviation = operator.deviation(problem.reference_state, problem.reference_action)
    axes = []
    for low, high, centre, sigma in zip(
        problem.state_lower, problem.state_upper, problem.reference_state, deviation, strict=True
    ):
        span = high - low
        spacing = max(0.5 * sigma, 1e-3 * span)
        features = [(x - spacing, x + spacing, spacing) for x in (low, centre, high)]
        lower, upper = low - 0.1 * span, high + 0.1 * span
        marks = sorted({lower, low, centre, high, upper})
        axes.append(graded_axis(marks, features, settings.growth**2))
    return Grid(tuple(axes))


def finer_grid(
    operator: BellmanOperator,
    found: Optimum,
    settings: Settings,
    level: int,
    *,
    smooth: bool = True,
) -> Grid:
    """Grid that resolves the support of a policy's distribution with cells·2^level cells a state.

    At a bound that the closed loop touches the cells are 2^-level of the standard deviation of one
    sample's disturbance: the penalty's kink reaches the value of a slow state smoothed by no more
    than that. The grid extends as far again beyond the support on either side, and at least a
    twentieth of the bounds' span: farther states are so rare that the policy at the box's edge
    serves them. Without disturbance the support is a point, which says nothing of that, and the box
    stays. `smooth`: cubic interpolation within the support, else linear everywhere.
    """
    problem = operator.problem
    span = problem.state_upper - problem.state_lower
    grid, mass = found.grid, np.maximum(found.distribution, 0.0)
    mean = mass @ np.column_stack([grid.points, found.actions]) / mass.sum()
    deviation = operator.deviation(mean[: problem.n_states], mean[problem.n_states :])
    mass = mass.reshape(grid.shape)
    axes, intervals = [], []
    for i, axis in enumerate(grid.axes):
        others = tuple(j for j in range(mass.ndim) if j != i)
        # The interval that holds all but `tail` of the mass at each end, and a cell on either side.
        cumulative = np.cumsum(mass.sum(axis=others)) / mass.sum(axis=others).sum()
        ends = np.searchsorted(cumulative, (settings.tail, 1.0 - settings.tail))
        first, last = axis[max(ends[0] - 1, 0)], axis[min(ends[1] + 1, len(axis) - 1)]
        reference, width = problem.reference_state[i], last - first
        features = [(first, last, width / (settings.cells * 2**level))]
        bounds = [
            bound
            for bound in (problem.state_lower[i], problem.state_upper[i])
            if first - deviation[i] <= bound <= last + deviation[i]
        ]
        near = max(deviation[i], 1e-3 * span[i])
        features += [(b - near, b + near, near / 2**level) for b in bounds]
        beyond = max(width, (1.0 if operator.deterministic else 0.05) * span[i])
        low = max(axis[0], min(first, reference) - beyond)
        high = min(axis[-1], max(last, reference) + beyond)
        marks = [low, *(x for x in sorted({*bounds, reference}) if low < x < high), high]
        axes.append(graded_axis(marks, features, settings.growth))
        # Beyond a bound the value has kinks wherever one more sample is needed to return.
        intervals.append((max(first, problem.state_lower[i]), min(last, problem.state_upper[i])))
    return Grid(tuple(axes), tuple(intervals) if smooth else None)


def graded_axis(marks: Sequence[float], features: Sequence[Feature], growth: float) -> Array:
    """Axis through all `marks`, dense at features, each cell outwards about `growth` times wider.

    The width of a cell at x is the least over the features of spacing + (growth − 1)·distance.
    """
    parts = []
    for lower, upper in pairwise(marks):
        fine = np.linspace(lower, upper, 4001)
        middle = 0.5 * (fine[1:] + fine[:-1])
        width = np.full(len(middle), upper - lower)
        for first, last, spacing in features:
            distance = np.maximum(np.maximum(first - middle, middle - last), 0.0)
            np.minimum(width, spacing + (growth - 1.0) * distance, out=width)
        count = np.append(0.0, np.cumsum(np.diff(fine) / width))
        cells = max(int(np.ceil(count[-1] - 1e-6)), 1)
        inner = np.interp(np.arange(1, cells) * (count[-1] / cells), count, fine)
        parts.append(np.concatenate([[lower], inner]))
    return np.concatenate([*parts, [marks[-1]]])


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
        centre, worst = vertices[rows, :-1].mean(axis=1), vertices[rows, -1]
        candidate = np.clip(2.0 * centre - worst, lower, upper)
        reflected = objective(rows, candidate)
        best = reflected < values[rows, 0]
        accepted = reflected < values[rows, -2]
        # Expansion, outside contraction and inside contraction as multiples of centre − worst.
        factor = np.where(best, 2.0, np.where(reflected < values[rows, -1], 0.5, -0.5))
        trial = np.clip(centre + factor[:, None] * (centre - worst), lower, upper)
        tried = np.flatnonzero(best | ~accepted)
        outcome = np.full(len(rows), np.inf)
        if len(tried):
            outcome[tried] = objective(rows[tried], trial[tried])
        candidate = np.where((outcome < reflected)[:, None], trial, candidate)
        outcome = np.minimum(outcome, reflected)
        improved = outcome < values[rows, -1]
        vertices[rows[improved], -1] = candidate[improved]
        values[rows[improved], -1] = outcome[improved]
        shrinking = rows[~improved]
        for i in range(1, m + 1):
            if len(shrinking):
                vertices[shrinking, i] = 0.5 * (vertices[shrinking, 0] + vertices[shrinking, i])
                values[shrinking, i] = objective(shrinking, vertices[shrinking, i])
    best = values.argmin(axis=1)
    return vertices[everyone, best], values[everyone, best]


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


# Each sample starts anew at the anchor with this probability, so that a plant without disturbance,
# which may come to rest in several places, still has one gain; it shifts J* by 1e-10 of itself.
_RESTART = 1e-9


class Figure(NamedTuple):
    """One way to J*: its value and the interval [lower, upper] that it is known to."""

    name: str
    value: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Optimum:
    """A policy on a grid with its value; of a solved problem the optimal one, certified or not.

    `actions` (G, m); `W` (G,) smooth part of the value, V = penalty + W, zero at the grid's anchor;
    `gain` mean cost per sample of the policy, J* in the end; `distribution` (G,) the stationary
    one; `lower` and `upper`, min and max over the grid of TW − W, enclose the optimal gain (Odoni,
    1969). `certificate` holds what was compared with the gain (see `certify`), `step` (G, m) the
    last change of the actions.
    """

    grid: Grid
    actions: Array
    W: Array
    gain: float
    distribution: Array
    accuracy: Accuracy
    lower: float = -np.inf
    upper: float = np.inf
    certificate: tuple[Figure, ...] = ()
    step: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def edge_mass(self) -> float:
        """Share of samples that the closed loop spends on the edge of the grid's box."""
        return float(self.distribution[self.grid.boundary].sum())


def evaluate(
    operator: BellmanOperator, grid: Grid, actions: Array, anchor: int
) -> tuple[Array, float, Array]:
    """Value W (G,), gain and stationary distribution (G,) of a policy (G, m).

    W + g = c + P W with W[anchor] = 0, by one sparse factorisation. Raises OptimumError where the
    chain cannot be evaluated.
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
    solution = factors.solve(np.append(cost, 0.0))
    return solution[:size], float(solution[size]), distribution


def begin(operator: BellmanOperator, grid: Grid, actions: Array, share: float = 1.0) -> Optimum:
    """Evaluate a first policy (G, m); its `step` is a tenth of the action box times `share`."""
    problem = operator.problem
    width = problem.action_upper - problem.action_lower
    W, gain, mass = evaluate(operator, grid, actions, grid.nearest(problem.reference_state))
    step = share * np.tile(0.1 * width, (grid.size, 1))
    return Optimum(grid, actions, W, gain, mass, operator.accuracy, step=step)


def improve(operator: BellmanOperator, iterate: Optimum, scan_points: int) -> Optimum:
    """Improve the policy once and bound what is left to gain.

    A local search in each state from its present action or, where one is better, from one of
    `scan_points` actions per dimension over the box: `lower` is a bound as far as these find the
    global minimum. Returns the improved actions with the value of the former ones and its bounds.
    """
    problem, grid = operator.problem, iterate.grid
    lower, upper = problem.action_lower, problem.action_upper

    def objective(rows: Rows, actions: Array) -> Array:
        return operator.values(grid.points[rows], actions, grid, iterate.W)

    start, _ = scan(objective, iterate.actions, lower, upper, scan_points)
    width = upper - lower
    size = np.clip(2.0 * np.abs(iterate.step), 2e-3 * width, 0.1 * width)
    precision = 1e-8 * abs(iterate.gain)
    actions, values = nelder_mead(
        objective, start, size, lower, upper, iterations=30, precision=precision
    )
    residual = values - iterate.W
    return replace(
        iterate,
        actions=actions,
        step=actions - iterate.actions,
        lower=float(residual.min()),
        upper=float(residual.max()),
    )


class Progress(NamedTuple):
    """Where the solver is: grid level, round on it, size of the grid, gain and its bounds."""

    level: int
    round: int
    states: int
    gain: float
    lower: float
    upper: float


TOLERANCE = 5e-4
"""Relative distance within which the figures of a certificate must agree."""
AGREEING = ("solution", "refinement", "simulation")
SEARCH = "policy search"


def objection(certificate: Sequence[Figure]) -> str | None:
    """Why a certified solution is not to be called J*; None where there is nothing against it."""
    made = {figure.name: figure for figure in certificate}
    if missing := [name for name in AGREEING if name not in made]:
        return f"not made: {', '.join(missing)}"
    agreeing = [made[name] for name in AGREEING]
    values = [figure.value for figure in agreeing]
    spread = (max(values) - min(values)) / abs(min(values))
    if spread > TOLERANCE:
        return (
            f"solution, refinement and simulation are {100 * spread:.3f} % apart, more "
            f"than {100 * TOLERANCE:g} %"
        )
    allowed = TOLERANCE * abs(values[0])
    for figure in agreeing:
        if figure.upper - figure.lower > 2 * allowed:
            return f"the interval of the {figure.name} is wider than {2 * allowed:.3g}"
    if SEARCH in made and made[SEARCH].upper < values[1] - allowed:
        return (
            f"a policy search found {made[SEARCH].value:.2f}, more than {100 * TOLERANCE:g} % "
            "below the refinement"
        )
    return None


def solve(
    plant: PlantProblem,
    settings: Settings | None = None,
    *,
    workers: int = 2,
    progress: Callable[[Progress], None] | None = None,
) -> Optimum:
    """Solve for the optimal policy of the stochastic plant by Howard's policy iteration.

    Raises OptimumError where the bounds do not close to 1 % of the gain, or where the closed loop
    leaves the grid's box in more than one of 10⁴ samples.
    """
    problem, settings = plant.problem, settings or Settings()
    accuracy = settings.accuracy(plant)
    draft, operator = (
        BellmanOperator(plant, how, workers=workers) for how in (accuracy.draft(), accuracy)
    )
    grid = first_grid(problem, draft, settings)
    iterate = begin(draft, grid, np.tile(problem.reference_action, (grid.size, 1)))
    run = partial(_iterate, settings=settings, progress=progress)
    approach = partial(run, draft, scan_points=5, enough=_settled)
    level = 0
    # Linear interpolation is monotone, so that it finds its way from anywhere, and it smears the
    # closed loop over its cells, so that the support is known only once these are fine.
    grids = [(1, False), *((k + 1, True) for k in range(settings.level))]
    for finer, smooth in grids if settings.level else ():
        iterate = approach(iterate, level)
        grid = finer_grid(draft, iterate, settings, finer, smooth=smooth)
        iterate = begin(draft, grid, iterate.grid.resample(iterate.actions, grid), 0.1)
        level = finer
    # One round that looks for better actions in the whole action box.
    iterate = run(draft, approach(iterate, level), level, scan_points=9, enough=lambda *_: True)
    return _accepted(run(operator, iterate, level), accuracy)


def refine(
    plant: PlantProblem,
    settings: Settings,
    optimum: Optimum,
    *,
    level: int | None = None,
    accuracy: Accuracy | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Optimum:
    """Solve again from a solution, on the grid of another level or with another accuracy.

    Raises OptimumError as `solve` does.
    """
    operator = BellmanOperator(plant, accuracy or optimum.accuracy, workers=2)
    start = begin(operator, optimum.grid, optimum.actions)
    grid = optimum.grid if level is None else finer_grid(operator, start, settings, level)
    start = begin(operator, grid, start.grid.resample(start.actions, grid), 0.1)
    level = settings.level if level is None else level
    return _accepted(_iterate(operator, start, level, settings, progress), operator.accuracy)


def _iterate(
    operator: BellmanOperator,
    iterate: Optimum,
    level: int,
    settings: Settings,
    progress: Callable[[Progress], None] | None,
    *,
    scan_points: int = 3,
    enough: Callable[[Optimum, Optimum], bool] | None = None,
) -> Optimum:
    """Improve and evaluate until `enough(before, after)`, without it until the bounds meet."""
    anchor = iterate.grid.nearest(operator.problem.reference_state)
    for k in range(settings.rounds):
        before, better = iterate, improve(operator, iterate, scan_points)
        W, gain, distribution = evaluate(operator, better.grid, better.actions, anchor)
        iterate = replace(better, W=W, gain=gain, distribution=distribution)
        lower, upper = iterate.lower, iterate.upper
        if progress is not None:
            progress(Progress(level, k, iterate.grid.size, gain, lower, upper))
        met = upper - lower <= settings.tolerance * abs(gain)
        if enough(before, iterate) if enough else met:
            break
    return iterate


def _settled(before: Optimum, after: Optimum) -> bool:
    """Whether the gain falls no more: a start for the next grid needs no bounds."""
    return before.gain - after.gain <= 1e-4 * abs(after.gain)


def _accepted(found: Optimum, accuracy: Accuracy) -> Optimum:
    gain, lower, upper = found.gain, found.lower, found.upper
    if upper - lower > 0.01 * abs(gain):
        raise OptimumError(
            f"policy iteration: the bounds of the gain, {lower:.6g} and {upper:.6g}, are more than "
            "1 % apart; allow more rounds or another grid"
        )
    mass, lower, upper = np.maximum(found.distribution, 0.0), min(lower, gain), max(upper, gain)
    found = replace(found, distribution=mass, lower=lower, upper=upper, accuracy=accuracy)
    if found.edge_mass > 1e-4:
        raise OptimumError(
            f"the optimal closed loop is on the edge of the grid's box in "
            f"{100 * found.edge_mass:.3g} % of the samples; widen the state bounds"
        )
    return found


def simulate_policy(
    plant: PlantProblem, optimum: Optimum, *, paths: int = 2000, steps: int = 5000
) -> tuple[float, float]:
    """Mean cost per sample of a solution's policy on the plant's model, and half its 95 % interval.

    The policy is interpolated as the controller does it. Each path starts in a state drawn from the
    solution's stationary distribution, and its first 300 samples are left out. The interval
    is that of the mean of independent paths.
    """
    generator, burn_in = np.random.default_rng(0), 300
    problem = plant.problem
    step = Elementwise(discretise(problem.model, problem.sampling_time, optimum.accuracy.substeps))
    cost = Elementwise(economic_cost(problem.model))
    table = Grid(optimum.grid.axes)
    policy = [table.interpolant(column) for column in optimum.actions.T]
    share = optimum.distribution / optimum.distribution.sum()
    x = list(table.points[generator.choice(table.size, paths, p=share)].T)
    total = np.zeros(paths)
    for k in range(burn_in + steps):
        u = [entry(x) for entry in policy]
        d = list(plant.law.draw(generator, paths).T)
        if k >= burn_in:
            total += cost(x, u, d, plant.parameters)[0]
            violations = problem.penalty.violation(np.stack(x, axis=1)).T
            weights = zip(problem.penalty_linear, problem.penalty_quadratic, strict=True)
            for v, (linear, quadratic) in zip(violations, weights, strict=True):
                total += (linear + quadratic * v) * v
        x = [np.broadcast_to(entry, paths) for entry in step(x, u, d, plant.parameters)]
    means = total / steps
    half_width = 1.96 * means.std(ddof=1) / np.sqrt(paths)
    return float(means.mean()), float(half_width)


STABLE = 1e-3
_MOST_GRIDS = 3


@dataclass(frozen=True)
class Row:
    """A solution of the study; `change` is that of J* against what it refines, relative."""

    name: str
    optimum: Optimum
    change: float | None = None

    @property
    def sizes(self) -> tuple[tuple[int, ...], ...]:
        """Grid points a state, quadrature nodes and those of the penalty a disturbance."""
        accuracy = self.optimum.accuracy
        return self.optimum.grid.shape, accuracy.nodes, accuracy.penalty_nodes

    def to_dict(self) -> dict[str, Any]:
        """The row as JSON has it."""
        found = self.optimum
        return {
            "name": self.name,
            "J": found.gain,
            "lower": found.lower,
            "upper": found.upper,
            "states": found.grid.shape,
            "accuracy": asdict(found.accuracy),
            "change": self.change,
        }

    @property
    def stable(self) -> bool:
        """Whether refining changed J* by no more than 0.1 %."""
        return self.change is None or self.change <= STABLE


def study(
    plant: PlantProblem,
    settings: Settings,
    optimum: Optimum,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> list[Row]:
    """Refine a solution of `settings` until J* is stable to 0.1 %, then its quadrature once.

    The grid is halved at least once and at most three times; the last row has the finer
    quadrature and integrator on the first grid. `stable` of the last two rows is the verdict.
    """
    rows = [Row("solution", optimum)]
    for level in range(settings.level + 1, settings.level + 1 + _MOST_GRIDS):
        before = rows[-1].optimum
        after = refine(plant, settings, before, level=level, progress=progress)
        rows.append(Row("grid twice as fine", after, _change(before, after)))
        if rows[-1].stable:
            break
    finer = optimum.accuracy.finer()
    after = refine(plant, settings, optimum, accuracy=finer, progress=progress)
    return [*rows, Row("quadrature finer", after, _change(optimum, after))]


def certify(
    plant: PlantProblem, rows: Sequence[Row], *, paths: int = 2000, steps: int = 5000
) -> Optimum:
    """The first refinement of a study, with its certificate.

    It is what is kept, since it is nearer to J* than the solution that the study began with. The
    certificate's figures are `solution`: the gain and its bounds on the grid; `refinement`: the
    same on the grid of the next level; `simulation`: the mean cost of the refinement's policy on
    the plant's model, 95 %; and, where it is added, `policy search`: the best θ that a search
    found, compared with that policy on the same noise.
    """
    found = [row.optimum for row in rows[:2]]
    mean, half_width = simulate_policy(plant, found[1], paths=paths, steps=steps)
    bounds = [(each.gain, each.lower, each.upper) for each in found]
    bounds.append((mean, mean - half_width, mean + half_width))
    figures = (Figure(name, *numbers) for name, numbers in zip(AGREEING, bounds, strict=True))
    return replace(found[1], certificate=tuple(figures))


def _change(before: Optimum, after: Optimum) -> float:
    return abs(after.gain - before.gain) / abs(after.gain)
