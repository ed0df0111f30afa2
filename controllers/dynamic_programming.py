"""Dynamic programming on a grid of states: interpolation, Bellman operator, policy iteration."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ModelError, OptimumError
from controllers.model import discretise, economic_cost
from controllers.problem import DisturbanceLaw, PlantProblem, Problem
from cosim.core.protocols import Array

# A stored optimum is read without SciPy, which takes longer to load than the optimum.
if TYPE_CHECKING:
    from scipy import sparse

Indices = NDArray[np.intp]
CUBIC_POINTS = 4
"""Points of an axis that a cubic goes through."""


class AxisInterpolant:
    """Polynomials through the points of an axis: cubic in the cells within `smooth`, linear else.

    In cell c, x = axis[c] + t, the weight of point `first`[c] + j is Σ_i `weights`[i, j, c] tⁱ,
    `weights` (powers, stencil points, cells). A cell's cubic runs through its ends and the next
    point on either side. No cubic uses a point outside `smooth`, where there may be a kink; fewer
    than four points within leave all linear.
    """

    def __init__(self, axis: Array, smooth: tuple[float, float] | None) -> None:
        n_points = len(axis)
        n_cells = n_points - 1
        cubic = _cells_within(axis, smooth)
        any_cubic = cubic.sum() >= CUBIC_POINTS - 1
        stencil_size = CUBIC_POINTS if any_cubic else 2

        # The stencil is about the cell, but within the axis, and a cubic's within the smooth part.
        centred = np.arange(n_cells) - (stencil_size // 2 - 1)
        first = np.clip(centred, 0, n_points - stencil_size)
        if any_cubic:
            cubic_cells = np.flatnonzero(cubic)
            last_first = cubic_cells[-1] + 2 - CUBIC_POINTS
            first[cubic] = np.clip(first[cubic], cubic_cells[0], last_first)

        weights = np.zeros((stencil_size, stencil_size, n_cells))
        for c in range(n_cells):
            points = range(c, c + 2)
            if any_cubic and cubic[c]:
                points = range(first[c], first[c] + CUBIC_POINTS)
            for j in points:
                polynomial = _lagrange_polynomial(axis, j, points, axis[c])
                n_powers = len(polynomial)
                weights[:n_powers, j - first[c], c] = polynomial

        self.axis = axis
        self.first = first
        self.weights = weights

    def locate(self, x: Array) -> tuple[Indices, Array]:
        """Cells of coordinates and offsets in them; outside the axis, those of its ends."""
        lowest = self.axis[0]
        highest = self.axis[-1]
        inside = np.clip(x, lowest, highest)
        inner_points = self.axis[1:-1]
        cell = np.searchsorted(inner_points, inside, side="right")
        offset = inside - self.axis[cell]
        return cell, offset


def _cells_within(axis: Array, interval: tuple[float, float] | None) -> NDArray[np.bool_]:
    """Which cells of an axis lie in an interval, up to rounding; none where it is None."""
    if interval is None:
        return np.zeros(len(axis) - 1, dtype=bool)
    lower, upper = interval
    tolerance = 1e-9 * (axis[-1] - axis[0])
    begins_within = axis[:-1] >= lower - tolerance
    ends_within = axis[1:] <= upper + tolerance
    return np.asarray(begins_within & ends_within)


def _lagrange_polynomial(
    axis: Array,
    j: int,
    points: Sequence[int],
    origin: float,
) -> Array:
    """Coefficients, in powers of x − origin, of the polynomial that is 1 at axis[j], 0 at others.

    The others are the points of the axis with the indices `points`.
    """
    polynomial = np.ones(1)
    for k in points:
        if k == j:
            continue
        # The factor (x − axis[k]) / (axis[j] − axis[k]).
        width = axis[j] - axis[k]
        constant = (origin - axis[k]) / width
        slope = 1 / width
        polynomial = np.convolve(polynomial, [constant, slope])
    return polynomial


@dataclass(frozen=True)
class Grid:
    """The product of increasing axes, one per state, at least two points each.

    `smooth` has an interval per state in which interpolation is cubic; elsewhere it is multilinear.
    Weights sum to one; multilinear ones are non-negative too, as those of a Markov chain. A state
    outside the box is moved to the nearest one inside.
    """

    axes: tuple[Array, ...]
    smooth: tuple[tuple[float, float], ...] | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of points per state."""
        return tuple(len(axis) for axis in self.axes)

    @property
    def size(self) -> int:
        """Number of grid states G."""
        return int(np.prod(self.shape))

    @cached_property
    def points(self) -> Array:
        """Grid states, shape (G, n), the last state running fastest."""
        mesh = np.meshgrid(*self.axes, indexing="ij")
        columns = [coordinate.reshape(-1) for coordinate in mesh]
        return np.stack(columns, axis=1)

    def nearest(self, state: Sequence[float] | Array) -> int:
        """Index of the grid state nearest to `state` in each coordinate."""
        index = []
        for axis, x in zip(self.axes, state, strict=True):
            distance = np.abs(axis - x)
            index.append(int(distance.argmin()))
        return int(np.ravel_multi_index(index, self.shape))

    def weights(self, x: Sequence[Array]) -> list[tuple[Indices, Array]]:
        """Grid indices and weights of interpolation at states given as one array per entry."""
        # The empty product: one corner, at index 0, of weight 1.
        origin: Indices = np.zeros((), dtype=np.intp)
        corners: list[tuple[Indices, Array]] = [(origin, np.ones(()))]
        for interpolant, values in zip(self._interpolants, x, strict=True):
            n_points = len(interpolant.axis)
            cell, offset = interpolant.locate(values)
            first = interpolant.first[cell]
            stencil = []
            for j in range(interpolant.weights.shape[1]):
                factor = _horner(interpolant.weights[:, j], cell, [offset])
                stencil.append((first + j, factor))
            # Each corner so far has one successor for each point of this axis' stencil.
            extended = []
            for index, weight in corners:
                for position, factor in stencil:
                    index_here = index * n_points + position
                    weight_here = weight * factor
                    extended.append((index_here, weight_here))
            corners = extended
        return corners

    def interpolant(self, values: Array) -> Callable[[Sequence[Array]], Array]:
        """Function that interpolates `values` (G,) at states given as one array per entry."""
        # Coefficients of the polynomial of each cell: one axis after the other.
        table = values.reshape(self.shape)
        for interpolant in self._interpolants:
            stencil_size = interpolant.weights.shape[1]
            stencil = interpolant.first + np.arange(stencil_size)[:, None]
            # The first axis becomes (power, cell), and both go last.
            table = np.einsum("ijc,jc...->...ic", interpolant.weights, table[stencil])

        # Powers first, as `_horner` reads them; the cells behind them become one axis.
        n = len(self.axes)
        powers = range(0, 2 * n, 2)
        cells = range(1, 2 * n, 2)
        table = table.transpose(*powers, *cells)
        n_powers = table.shape[:n]
        table = np.ascontiguousarray(table.reshape(*n_powers, -1))

        def function(x: Sequence[Array]) -> Array:
            index: Indices = np.zeros((), dtype=np.intp)
            offsets = []
            for interpolant, entry in zip(self._interpolants, x, strict=True):
                cell, offset = interpolant.locate(entry)
                n_cells = len(interpolant.axis) - 1
                index = index * n_cells + cell
                offsets.append(offset)
            return _horner(table, index, offsets)

        return function

    @cached_property
    def _interpolants(self) -> list[AxisInterpolant]:
        smooth = self.smooth or (None,) * len(self.axes)
        interpolants = []
        for axis, interval in zip(self.axes, smooth, strict=True):
            interpolants.append(AxisInterpolant(axis, interval))
        return interpolants


def _horner(table: Array, index: Indices, offsets: Sequence[Array]) -> Array:
    """Polynomial in `offsets` of the coefficients `table[i, j, …, index]`, by Horner's rule."""
    if not offsets:
        return np.asarray(table[index])
    first, *rest = offsets
    total = _horner(table[-1], index, rest)
    for part in table[-2::-1]:
        total = total * first + _horner(part, index, rest)
    return total


Feature = tuple[float, float, float]
"""First and last point of an interval of an axis, and the width that its cells shall not exceed."""


def graded_axis(
    marks: Sequence[float],
    features: Sequence[Feature],
    growth: float,
) -> Array:
    """Axis through all `marks`, dense at features, each cell outwards about `growth` times wider.

    The width of a cell at x is the least over the features of spacing + (growth − 1)·distance.

    Args:
        marks: Points of the axis, increasing: the first and last ones are its ends.
        features: Where the axis is dense.
        growth: Ratio of the widths of neighbouring cells, above 1.
    """
    pieces = [_graded_piece(lower, upper, features, growth) for lower, upper in pairwise(marks)]
    end = np.array([marks[-1]])
    return np.concatenate([*pieces, end])


def _graded_piece(
    lower: float,
    upper: float,
    features: Sequence[Feature],
    growth: float,
) -> Array:
    """The points of `graded_axis` between two marks, the lower one included."""
    # The wanted width of a cell, as a function of its place, on a fine partition.
    fine = np.linspace(lower, upper, 4001)
    middle = 0.5 * (fine[1:] + fine[:-1])
    width = np.full(len(middle), upper - lower)
    for first, last, spacing in features:
        outside = np.maximum(first - middle, middle - last)
        distance = np.maximum(outside, 0.0)
        allowed = spacing + (growth - 1.0) * distance
        np.minimum(width, allowed, out=width)

    # Number of cells from `lower` to each point, the integral of 1/width. The axis has the points
    # where it is a whole number, after the last count is rounded up to one.
    increments = np.diff(fine) / width
    count = np.append(0.0, np.cumsum(increments))
    n_cells = max(int(np.ceil(count[-1] - 1e-6)), 1)
    whole = np.arange(1, n_cells) * (count[-1] / n_cells)
    inner = np.interp(whole, count, fine)
    return np.append(lower, inner)


def gauss_rule(
    law: DisturbanceLaw,
    counts: tuple[int, ...],
) -> tuple[list[Array], Array]:
    """Nodes of each disturbance, and the weights of their product, the last one's running fastest.

    Gauss–Legendre for the uniform law, Gauss–Hermite for the normal one, one node for a disturbance
    that does not vary. Exact for polynomials of degree 2·count−1 in each; the weights sum to 1.

    Args:
        law: Law of the disturbances.
        counts: Number of nodes of each.
    """
    axes = []
    weights = np.ones(1)
    for count, nominal, spread in zip(counts, law.nominal, law.ranges, strict=True):
        if law.kind == "none" or spread == 0:
            x = np.zeros(1)
            w = np.ones(1)
        elif law.kind == "uniform":
            x, w = np.polynomial.legendre.leggauss(count)
        else:
            x, w = np.polynomial.hermite_e.hermegauss(count)
        axes.append(nominal + spread * x)
        probabilities = w / w.sum()
        weights = np.multiply.outer(weights, probabilities).reshape(-1)
    return axes, weights


class Refinement:
    """Polynomial interpolation of a smooth function from one product of nodes to another."""

    def __init__(
        self,
        coarse: Sequence[Array],
        fine: Sequence[Array],
    ) -> None:
        matrices = []
        for nodes, targets in zip(coarse, fine, strict=True):
            matrices.append(_lagrange_matrix(nodes, targets))
        # Products of tiny matrices cost more in calls than in arithmetic: join the last axes.
        while len(matrices) > 1 and matrices[-1].shape[1] < 4:
            last = matrices.pop()
            joined = np.kron(matrices.pop(), last)
            matrices.append(joined.astype(np.float64))
        self._matrices = matrices

    def __call__(self, values: Array) -> Array:
        """Carry values (B, q_coarse) to (B, q_fine)."""
        count = len(values)
        n_fine = 1  # size of the axes that are fine already, the last ones
        for matrix in reversed(self._matrices):
            fine, coarse = matrix.shape
            if n_fine == 1:
                values = values.reshape(count, -1, coarse) @ matrix.T
            else:
                values = matrix @ values.reshape(-1, coarse, n_fine)
            n_fine *= fine
        return values.reshape(count, -1)


def _lagrange_matrix(nodes: Array, targets: Array) -> Array:
    """Values at the targets (t,) of the Lagrange polynomials of the nodes (q,), shape (t, q)."""
    matrix = np.ones((len(targets), len(nodes)))
    for j, k in itertools.permutations(range(len(nodes)), 2):
        width = nodes[j] - nodes[k]
        matrix[:, j] *= (targets - nodes[k]) / width
    return matrix


def _truth(condition: Any) -> Any:
    """1 where a condition holds, else 0, as CasADi has its truth values."""
    return np.where(condition, 1.0, 0.0)


# NumPy's counterparts of CasADi's elementary operations, by their codes.
_OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_ADD: operator.add,
    ca.OP_SUB: operator.sub,
    ca.OP_MUL: operator.mul,
    ca.OP_DIV: operator.truediv,
    ca.OP_NEG: operator.neg,
    ca.OP_TWICE: lambda a: a + a,
    ca.OP_SQ: lambda a: a * a,
    ca.OP_INV: lambda a: 1.0 / a,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_LT: lambda a, b: _truth(a < b),
    ca.OP_LE: lambda a, b: _truth(a <= b),
    ca.OP_EQ: lambda a, b: _truth(a == b),
    ca.OP_NE: lambda a, b: _truth(a != b),
    ca.OP_NOT: lambda a: _truth(a == 0),
    ca.OP_AND: lambda a, b: _truth((a != 0) & (b != 0)),
    ca.OP_OR: lambda a, b: _truth((a != 0) | (b != 0)),
    ca.OP_IF_ELSE_ZERO: lambda a, b: np.where(a != 0, b, 0.0),
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_LOG1P: np.log1p,
    ca.OP_EXPM1: np.expm1,
    ca.OP_SQRT: np.sqrt,
    ca.OP_HYPOT: np.hypot,
    ca.OP_SIGN: np.sign,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_FABS: np.fabs,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
}


class Instruction(NamedTuple):
    """An instruction of a CasADi function: its code, and the places of its inputs and outputs.

    The input of a constant is its value.
    """

    code: int
    inputs: Sequence[Any]
    outputs: Sequence[int]


class Elementwise:
    """An SX function f(x, u, …) → y over arrays that broadcast.

    Each argument is a sequence with one array per scalar entry; the result is the list of y's
    entries. Five to ten times faster on large arrays than CasADi's `map`. Raises
    ModelError on an operation that has no NumPy counterpart here.
    """

    def __init__(self, function: ca.Function) -> None:
        self._n_work = function.sz_w()
        self._n_out = function.size1_out(0)
        self._out_rows = list(function.sparsity_out(0).row())
        self._program: list[Instruction] = []
        evaluated = (ca.OP_INPUT, ca.OP_OUTPUT, *_OPERATIONS)
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            inputs: Sequence[Any] = function.instruction_input(k)
            if code == ca.OP_CONST:
                inputs = [function.instruction_constant(k)]
            elif code not in evaluated:
                what = f"operation {code} of CasADi"
                if code == ca.OP_CALL:
                    what = "a call of a CasADi function, such as a table,"
                raise ModelError(
                    f"function '{function.name()}': {what} cannot be evaluated over arrays; "
                    "write the model without it"
                )
            outputs = function.instruction_output(k)
            self._program.append(Instruction(code, inputs, outputs))

    def __call__(self, *arguments: Any) -> list[Any]:
        """Evaluate; `arguments[i][j]` is entry j of argument i."""
        work: list[Any] = [0.0] * self._n_work
        result: list[Any] = [0.0] * self._n_out
        for code, inputs, outputs in self._program:
            if code == ca.OP_CONST:
                work[outputs[0]] = inputs[0]
            elif code == ca.OP_INPUT:
                argument, entry = inputs
                work[outputs[0]] = arguments[argument][entry]
            elif code == ca.OP_OUTPUT:
                # An output's rows are those of its non-zeros.
                row = self._out_rows[outputs[1]]
                result[row] = work[inputs[0]]
            else:
                operation = _OPERATIONS[code]
                operands = [work[place] for place in inputs]
                work[outputs[0]] = operation(*operands)
        return result


T = TypeVar("T")
ENTRIES_A_TASK = 100_000
"""Entries of an array (states × nodes) a task: fewer wait for the interpreter's lock, more do not
fit the cores' caches."""


@dataclass(frozen=True)
class Accuracy:
    """Integrator and quadrature of the stochastic plant.

    `substeps` RK4 steps a sample; Gauss nodes per disturbance: `nodes` for smooth functions,
    `penalty_nodes` for the penalty, which has a kink where the policy operates.
    """

    substeps: int
    nodes: tuple[int, ...]
    penalty_nodes: tuple[int, ...]

    def draft(self) -> Accuracy:
        """A quarter of the work, for grids that only give a start."""
        substeps = max(self.substeps // 2, 1)
        nodes = [min(count, 5) for count in self.nodes]
        penalty_nodes = [min(count, 10) for count in self.penalty_nodes]
        return Accuracy(substeps, tuple(nodes), tuple(penalty_nodes))


class BellmanOperator:
    """Q(s, a) = E[ℓ(s, a, d) + penalty(s₊) + W(s₊)] with V = penalty + W.

    Only the smooth W is interpolated; the penalty is exact. `workers` threads share the states;
    results do not depend on their number.
    """

    def __init__(
        self,
        plant: PlantProblem,
        accuracy: Accuracy,
        *,
        workers: int = 1,
    ) -> None:
        problem = plant.problem
        model = problem.model
        law = plant.law
        self.problem = problem
        self.deterministic = law.kind == "none" or not law.ranges.any()
        self.accuracy = accuracy
        self._step = Elementwise(discretise(model, problem.sampling_time, accuracy.substeps))
        self._cost = Elementwise(economic_cost(model))
        self._parameters = plant.parameters

        # The expectation is a sum over the product of each disturbance's nodes, (1, q) arrays.
        nodes, self._weights = gauss_rule(law, accuracy.nodes)
        mesh = np.meshgrid(*nodes, indexing="ij")
        self._disturbance = [values.reshape(1, -1) for values in mesh]
        penalty_nodes, self._penalty_weights = gauss_rule(law, accuracy.penalty_nodes)
        self._refine = Refinement(nodes, penalty_nodes)
        self._pool = None
        if workers > 1:
            self._pool = ThreadPoolExecutor(workers)

    def deviation(self, state: Array, action: Array) -> Array:
        """Standard deviation of the next state.

        Args:
            state: Present state, (n,).
            action: Action, (m,).

        Returns:
            One deviation a state, (n,).
        """
        _, x_next = self._expected_cost(state[None, :], action[None, :])
        x = np.concatenate(x_next)
        mean = x @ self._weights
        mean_square = (x * x) @ self._weights
        # Rounding may leave the variance of a state that does not vary below zero.
        variance = np.maximum(mean_square - mean**2, 0.0)
        return np.asarray(np.sqrt(variance))

    def values(
        self,
        states: Array,
        actions: Array,
        grid: Grid,
        W: Array,
    ) -> Array:
        """Q(s, a), shape (B,).

        Args:
            states: States, (B, n).
            actions: Actions, (B, m).
            grid: The grid.
            W: Smooth part of the value on the grid, (G,).
        """
        smooth = grid.interpolant(W)

        def values_of(part: slice) -> Array:
            cost, x_next = self._expected_cost(states[part], actions[part])
            value_to_go = smooth(x_next)
            return cost + _mean(value_to_go, self._weights)

        parts = list(self._map(values_of, len(states)))
        return np.concatenate(parts)

    def chain(
        self,
        actions: Array,
        grid: Grid,
    ) -> tuple[sparse.csr_array, Array]:
        """Markov chain of a policy on the grid.

        Args:
            actions: The policy at each of the grid's states, (G, m).
            grid: The grid.

        Returns:
            The transition matrix (G, G), and the cost E[ℓ + penalty(s₊)] of each state, (G,).
        """
        from scipy import sparse  # noqa: PLC0415

        def rows_of(part: slice) -> tuple[sparse.csr_array, Array]:
            cost, x_next = self._expected_cost(grid.points[part], actions[part])
            count, n_nodes = x_next[0].shape
            shape = (count, grid.size)
            rows = np.repeat(np.arange(count), n_nodes)
            # From state b to each corner of the cell that node q leads to: its probability times
            # the corner's weight. Entries of the same place add up.
            matrix = sparse.csr_array(shape)
            for index, weight in grid.weights(x_next):
                probabilities = (weight * self._weights).reshape(-1)
                places = (rows, index.reshape(-1))
                matrix += sparse.csr_array((probabilities, places), shape=shape)
            return matrix, cost

        parts = self._map(rows_of, grid.size)
        matrices, costs = zip(*parts, strict=True)
        transition = sparse.vstack(matrices, format="csr")
        return transition, np.concatenate(costs)

    def _expected_cost(
        self,
        states: Array,
        actions: Array,
    ) -> tuple[Array, list[Array]]:
        """E[ℓ + penalty(s₊)], shape (B,), and s₊ at the nodes, n arrays (B, q)."""
        # States and actions (B, 1) with disturbances (1, q): all arrays broadcast to (B, q).
        arguments = (
            [column[:, None] for column in states.T],
            [column[:, None] for column in actions.T],
            self._disturbance,
            self._parameters,
        )
        shape = (len(states), len(self._weights))
        x_next = [np.broadcast_to(entry, shape) for entry in self._step(*arguments)]
        (stage_cost,) = self._cost(*arguments)
        cost = _mean(np.broadcast_to(stage_cost, shape), self._weights)
        return cost + self._expected_penalty(x_next), x_next

    def _expected_penalty(self, x_next: Sequence[Array]) -> Array:
        """E[penalty(s₊)], shape (B,), of s₊ at the nodes, n arrays (B, q)."""
        problem = self.problem
        total = np.zeros(len(x_next[0]))
        for i, x in enumerate(x_next):
            lowest = x.min(axis=1)
            highest = x.max(axis=1)
            # The outermost Gauss nodes lie inside the law's support.
            reach = 0.25 * (highest - lowest)
            room_below = lowest - reach - problem.state_lower[i]
            room_above = highest + reach - problem.state_upper[i]
            # Only states that may violate a bound are worth the many nodes of the penalty.
            below = np.flatnonzero(room_below < 0)
            above = np.flatnonzero(room_above > 0)
            if len(below):
                total[below] += self._expected_bound_penalty(x[below], i, -1.0)
            if len(above):
                total[above] += self._expected_bound_penalty(x[above], i, 1.0)
        return total

    def _expected_bound_penalty(self, x: Array, i: int, sign: float) -> Array:
        """Expected penalty of one bound of state i, whose values are x (B, q) at the nodes.

        The bound is the upper one for `sign` 1, the lower one for −1. A state is smooth in the
        disturbances, so it is carried to the many nodes that the penalty's kink needs.
        """
        problem = self.problem
        bound = problem.state_upper[i] if sign > 0 else problem.state_lower[i]
        linear = problem.penalty_linear[i]
        quadratic = problem.penalty_quadratic[i]
        excess = sign * (self._refine(x) - bound)
        violation = np.maximum(excess, 0.0)
        penalty = (linear + quadratic * violation) * violation
        return _mean(penalty, self._penalty_weights)

    def _map(self, task: Callable[[slice], T], count: int) -> Iterator[T]:
        """Results of a task for slices of `count` states, by the threads where there are any."""
        entries = count * len(self._weights)
        n_tasks = min(-(-entries // ENTRIES_A_TASK), count)  # rounded up
        edges = np.linspace(0, count, n_tasks + 1).astype(int)
        parts = [slice(start, stop) for start, stop in pairwise(edges.tolist())]
        if self._pool is None:
            return map(task, parts)
        return self._pool.map(task, parts)


def _mean(values: Array, weights: Array) -> Array:
    """Weighted mean of each row, without BLAS, whose threads would compete with ours."""
    return np.asarray(np.einsum("bq,q->b", values, weights))


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


def accurate_substeps(plant: PlantProblem, tolerance: float) -> int:
    """Least power of two of RK4 substeps whose doubling moves no next state by more than allowed.

    Allowed is `tolerance`·(1 + |x|) at 2000 points: states within a quarter of the bounds' span of
    the reference, actions in their box, disturbances of the law.

    Args:
        plant: The plant's model with its law and parameters.
        tolerance: What is allowed, relative to 1 + |x|.

    Raises:
        OptimumError: 128 substeps are too few.
    """
    problem = plant.problem
    state_lower = problem.state_lower
    state_upper = problem.state_upper
    reference = problem.reference_state

    # Points (count, n), (count, m) and (count, n_d) that the closed loop may visit.
    generator = np.random.default_rng(0)
    count = 2000
    reach = 0.25 * (state_upper - state_lower)
    lower = np.maximum(state_lower, reference - reach)
    upper = np.minimum(state_upper, reference + reach)
    x = generator.uniform(lower, upper, (count, problem.n_states))
    u = generator.uniform(
        problem.action_lower,
        problem.action_upper,
        (count, problem.n_actions),
    )
    d = plant.law.draw(generator, count)
    allowed = tolerance * (1 + np.abs(x))

    before = np.full_like(x, np.inf)
    for substeps in (1, 2, 4, 8, 16, 32, 64, 128):
        step = Elementwise(discretise(problem.model, problem.sampling_time, substeps))
        # A step that is too long may overflow; then the next one is tried.
        with np.errstate(all="ignore"):
            entries = step(x.T, u.T, d.T, plant.parameters)
            columns = [np.broadcast_to(entry, count) for entry in entries]
            x_next = np.stack(columns, axis=1)
            change = np.abs(x_next - before)
        if np.all(change <= allowed):
            return substeps
        before = x_next
    raise OptimumError(
        f"model '{problem.model.name}': 128 RK4 substeps a sample do not integrate it to "
        f"{tolerance:g}; shorten the sampling time"
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
        first = lower - 0.1 * span
        last = upper + 0.1 * span
        marks = sorted({first, lower, reference, upper, last})
        axes.append(graded_axis(marks, features, settings.growth**2))
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
    deviation = operator.deviation(mean[:n], mean[n:])

    mass_on_grid = mass.reshape(grid.shape)
    axes = []
    intervals = []
    for i, axis in enumerate(grid.axes):
        others = tuple(j for j in range(n) if j != i)
        marginal = mass_on_grid.sum(axis=others)
        support = _support(axis, marginal, settings.tail)
        finer_axis = _refined_axis(operator, settings, level, i, axis, support, deviation[i])
        axes.append(finer_axis)
        # Beyond a bound the value has a kink wherever the return takes one more sample.
        first = max(support[0], problem.state_lower[i])
        last = min(support[1], problem.state_upper[i])
        intervals.append((first, last))
    finer = Grid(tuple(axes), tuple(intervals) if smooth else None)

    states = list(finer.points.T)
    linear = Grid(grid.axes)
    columns = []
    for action in optimum.actions.T:
        interpolated = linear.interpolant(action)
        columns.append(interpolated(states))
    return start_policy(operator, finer, np.stack(columns, axis=1), 0.1)


def _support(axis: Array, mass: Array, tail: float) -> tuple[float, float]:
    """Interval that holds all but `tail` of the mass at each end, and a cell on either side."""
    cumulative = np.cumsum(mass) / mass.sum()
    ends = np.searchsorted(cumulative, (tail, 1.0 - tail))
    first = max(ends[0] - 1, 0)
    last = min(ends[1] + 1, len(axis) - 1)
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
    features = [(first, last, width / (settings.cells * refinement))]
    marks = {reference}
    near = max(deviation, 1e-3 * span)
    for bound in (lower, upper):
        if first - deviation <= bound <= last + deviation:
            marks.add(bound)
            features.append((bound - near, bound + near, near / refinement))

    # Without disturbance a state that strays never comes into the support's mass: keep the box.
    share = 1.0 if operator.deterministic else 0.05
    beyond = max(width, share * span)
    low = max(axis[0], min(first, reference) - beyond)
    high = min(axis[-1], max(last, reference) + beyond)
    inner_marks = [x for x in sorted(marks) if low < x < high]
    return graded_axis([low, *inner_marks, high], features, settings.growth)


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
    m = start.shape[1]
    every_row = np.arange(len(start))
    vertices = _first_simplices(start, size, lower, upper)
    columns = [objective(every_row, vertices[:, i]) for i in range(m + 1)]
    values = np.stack(columns, axis=1)

    for _ in range(iterations):
        # The best vertex first, the worst one last.
        order = np.argsort(values, axis=1, kind="stable")
        values = np.take_along_axis(values, order, axis=1)
        vertices = np.take_along_axis(vertices, order[:, :, None], axis=1)
        spread = values[:, -1] - values[:, 0]
        rows = np.flatnonzero(spread > precision)
        if not len(rows):
            break
        best = values[rows, 0]
        second_worst = values[rows, -2]
        worst = values[rows, -1]

        # Reflect the worst vertex at the centre of the others.
        worst_vertex = vertices[rows, -1]
        centre = vertices[rows, :-1].mean(axis=1)
        candidate = np.clip(2.0 * centre - worst_vertex, lower, upper)
        reflected = objective(rows, candidate)
        is_best = reflected < best
        is_accepted = reflected < second_worst

        # Expansion, outside contraction and inside contraction as multiples of centre − worst.
        contraction = np.where(reflected < worst, 0.5, -0.5)
        factor = np.where(is_best, 2.0, contraction)[:, None]
        trial = np.clip(centre + factor * (centre - worst_vertex), lower, upper)
        tried = np.flatnonzero(is_best | ~is_accepted)
        outcome = np.full(len(rows), np.inf)
        if len(tried):
            outcome[tried] = objective(rows[tried], trial[tried])
        trial_is_better = (outcome < reflected)[:, None]
        candidate = np.where(trial_is_better, trial, candidate)
        outcome = np.minimum(outcome, reflected)

        improved = outcome < worst
        vertices[rows[improved], -1] = candidate[improved]
        values[rows[improved], -1] = outcome[improved]
        # What no point improved shrinks towards its best vertex.
        shrinking = rows[~improved]
        if not len(shrinking):
            continue
        for i in range(1, m + 1):
            halfway = 0.5 * (vertices[shrinking, 0] + vertices[shrinking, i])
            vertices[shrinking, i] = halfway
            values[shrinking, i] = objective(shrinking, halfway)

    best_vertex = values.argmin(axis=1)
    return vertices[every_row, best_vertex], values[every_row, best_vertex]


def _first_simplices(
    start: Array,
    size: Array,
    lower: Array,
    upper: Array,
) -> Array:
    """Vertices (B, m+1, m) of simplices with edges along the axes, within the box."""
    m = start.shape[1]
    inside = np.clip(start, lower, upper)
    vertices = np.repeat(inside[:, None], m + 1, axis=1)
    for i in range(m):
        # Vertex i+1 differs from the start in entry i, inwards where outwards leaves the box.
        entry = vertices[:, i + 1, i]
        outward = entry + size[:, i]
        inward = entry - size[:, i]
        moved = np.where(outward > upper[i], inward, outward)
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
    best = start.copy()
    values = objective(every_row, start)
    axes = [np.linspace(low, high, points) for low, high in zip(lower, upper, strict=True)]
    for point in itertools.product(*axes):
        candidate = np.broadcast_to(point, start.shape)
        outcome = objective(every_row, candidate)
        better = outcome < values
        best[better] = np.array(point)
        values[better] = outcome[better]
    return best, values


RESTART_PROBABILITY = 1e-9
"""Probability that a sample starts anew at the anchor: so a plant without disturbance, which may
come to rest in several places, has one gain. It shifts J* by 1e-10 of itself."""


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
        on_edge = np.zeros(self.grid.size, dtype=bool)
        for axis, x in zip(self.grid.axes, self.grid.points.T, strict=True):
            on_edge |= (x == axis[0]) | (x == axis[-1])
        return float(self.distribution[on_edge].sum())


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
        OptimumError: The chain cannot be evaluated.
    """
    from scipy import sparse  # noqa: PLC0415
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    # [I − P  1; e_anchorᵀ  0] (W, g) = (c, 0).
    transition, cost = operator.chain(actions, grid)
    size = grid.size
    unit = sparse.csr_array(([1.0], ([0], [anchor])), shape=(1, size))
    flow = sparse.eye_array(size) - (1.0 - RESTART_PROBABILITY) * transition
    ones = np.ones((size, 1))
    bordered = sparse.block_array([[flow, ones], [unit, None]], format="csc")
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
    anchor = grid.nearest(problem.reference_state)
    W, gain, distribution = evaluate_policy(operator, grid, actions, anchor)
    tenth = 0.1 * (problem.action_upper - problem.action_lower)
    return Optimum(
        grid=grid,
        actions=actions,
        W=W,
        gain=gain,
        distribution=distribution,
        accuracy=operator.accuracy,
        step=share * np.tile(tenth, (grid.size, 1)),
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
        return operator.values(grid.points[rows], actions, grid, iterate.W)

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
    problem = plant.problem
    settings = settings or Settings()
    accuracy = settings.accuracy(plant)
    draft = BellmanOperator(plant, accuracy.draft(), workers=workers)
    operator = BellmanOperator(plant, accuracy, workers=workers)
    run = partial(_iterate, settings=settings, progress=progress)
    approach = partial(run, draft, scan_points=5, start_only=True)

    # From the constant policy u_s to a first policy on the coarse grid.
    grid = first_grid(problem, draft, settings)
    constant = np.tile(problem.reference_action, (grid.size, 1))
    iterate = start_policy(draft, grid, constant)
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
    iterate = run(draft, iterate, settings.level, scan_points=9, rounds=1)
    return _accepted(run(operator, iterate, settings.level))


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
    burn_in = 300
    rng = np.random.default_rng(0)
    problem = plant.problem
    model = problem.model
    parameters = plant.parameters
    step = Elementwise(discretise(model, problem.sampling_time, optimum.accuracy.substeps))
    stage_cost = Elementwise(economic_cost(model))
    grid = Grid(optimum.grid.axes)
    policy = [grid.interpolant(column) for column in optimum.actions.T]

    probabilities = optimum.distribution / optimum.distribution.sum()
    start = rng.choice(grid.size, paths, p=probabilities)
    # An array (paths,) for each state, action and disturbance.
    x = list(grid.points[start].T)
    total = np.zeros(paths)
    for k in range(burn_in + steps):
        u = [action(x) for action in policy]
        disturbances = plant.law.draw(rng, paths)
        d = list(disturbances.T)
        if k >= burn_in:
            (cost,) = stage_cost(x, u, d, parameters)
            total += cost
            total += problem.penalty.along(np.stack(x, axis=1))
        x_next = step(x, u, d, parameters)
        # A state that depends on no other may be one number.
        x = [np.broadcast_to(state, paths) for state in x_next]

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
    start = refined(operator, optimum, settings, level)
    iterate = _iterate(operator, start, level, settings, progress)
    refinement = _accepted(iterate)
    mean, half_width = simulate_policy(plant, refinement, paths=paths, steps=steps)
    estimates = []
    for name, solution in (("solution", optimum), ("refinement", refinement)):
        estimates.append(GainEstimate(name, solution.gain, solution.lower, solution.upper))
    estimates.append(GainEstimate("simulation", mean, mean - half_width, mean + half_width))
    return replace(refinement, certificate=tuple(estimates))
