"""The Bellman operator of a stochastic plant: expectations of its cost and its next state."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from controllers.dynamic_programming.grid import Grid
from controllers.errors import ModelError, OptimumError
from controllers.model import economic_cost
from controllers.problem import DisturbanceLaw, PlantProblem
from cosim.core.protocols import Array

# A stored optimum is read without SciPy, which takes longer to load than the optimum.
if TYPE_CHECKING:
    from scipy import sparse


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
    # NumPy's rules are those of [−1, 1] and of e^(−x²/2); their weights do not sum to 1.
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
        product = np.multiply.outer(weights, probabilities)
        weights = product.reshape(-1)
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
        while len(matrices) > 1:
            _, n_coarse = matrices[-1].shape
            if n_coarse >= 4:
                break
            last = matrices.pop()
            last_but_one = matrices.pop()
            joined = np.kron(last_but_one, last)
            matrices.append(joined.astype(np.float64))
        self._matrices = matrices

    def __call__(self, values: Array) -> Array:
        """Carry values (B, q_coarse) to (B, q_fine)."""
        count = len(values)
        n_fine = 1  # size of the axes that are fine already, the last ones
        for matrix in reversed(self._matrices):
            fine, coarse = matrix.shape
            # One large product where the axis is the last, else one for each row of the others.
            if n_fine == 1:
                rows = values.reshape(count, -1, coarse)
                values = rows @ matrix.T
            else:
                columns = values.reshape(-1, coarse, n_fine)
                values = matrix @ columns
            n_fine *= fine
        return values.reshape(count, -1)


def _lagrange_matrix(nodes: Array, targets: Array) -> Array:
    """Values at the targets (t,) of the Lagrange polynomials of the nodes (q,), shape (t, q)."""
    count = len(nodes)
    pairs = itertools.permutations(range(count), 2)
    matrix = np.ones((len(targets), count))
    # The polynomial of node j has a factor for each other node k, at which it is zero.
    for j, k in pairs:
        width = nodes[j] - nodes[k]
        distance = targets - nodes[k]
        matrix[:, j] *= distance / width
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
        sparsity = function.sparsity_out(0)
        self._out_rows = list(sparsity.row())
        self._program: list[Instruction] = []
        # CasADi's own program, which is run on a work vector of arrays in place of numbers.
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
        return Accuracy(
            substeps=substeps,
            nodes=tuple(nodes),
            penalty_nodes=tuple(penalty_nodes),
        )


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
        varies = law.kind != "none" and law.ranges.any()
        self.deterministic = not varies
        self.accuracy = accuracy
        self._step = Elementwise(plant.sampled(accuracy.substeps))
        self._cost = Elementwise(economic_cost(model))
        self._parameters = plant.parameters

        # The expectation is a sum over the product of each disturbance's nodes, (1, q) arrays.
        nodes, self._weights = gauss_rule(law, accuracy.nodes)
        mesh = np.meshgrid(*nodes, indexing="ij")
        self._disturbance = [values.reshape(1, -1) for values in mesh]
        # The penalty has a kink, which many nodes must resolve; the smooth parts need few.
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
        states = state[None, :]
        actions = action[None, :]
        _, x_next = self._expected_cost(states, actions)
        # A row for each state, with a column for each node.
        x = np.concatenate(x_next)
        mean = x @ self._weights
        square = x * x
        mean_square = square @ self._weights
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
        # The coefficients of all cells, once for all slices.
        smooth = grid.interpolant(W)

        def values_of(part: slice) -> Array:
            states_of_part = states[part]
            actions_of_part = actions[part]
            cost, x_next = self._expected_cost(states_of_part, actions_of_part)
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
            states = grid.points[part]
            actions_of_part = actions[part]
            cost, x_next = self._expected_cost(states, actions_of_part)
            return self._transition(x_next, grid), cost

        # Rows of the grid's states in their order, whichever thread makes them.
        parts = self._map(rows_of, grid.size)
        matrices, costs = zip(*parts, strict=True)
        transition = sparse.vstack(matrices, format="csr")
        return transition, np.concatenate(costs)

    def transitions(
        self,
        states: Array,
        actions: Array,
        grid: Grid,
    ) -> tuple[sparse.csr_array, Array]:
        """Next states of actions, independent of the cost.

        Args:
            states: States, (B, n).
            actions: Actions, (B, m).
            grid: The grid.

        Returns:
            Weights of the grid's states in the expectation of a function of s₊, (B, G), and
            E[penalty(s₊)], (B,).
        """
        from scipy import sparse  # noqa: PLC0415

        def rows_of(part: slice) -> tuple[sparse.csr_array, Array]:
            arguments, shape = self._arguments(states[part], actions[part])
            x_next = self._next_states(arguments, shape)
            return self._transition(x_next, grid), self._expected_penalty(x_next)

        parts = self._map(rows_of, len(states))
        matrices, penalties = zip(*parts, strict=True)
        return sparse.vstack(matrices, format="csr"), np.concatenate(penalties)

    def stage_costs(
        self,
        states: Array,
        actions: Array,
        parameters: Array,
    ) -> Array:
        """E[ℓ(s, a, d)] where the plant's parameters are others, prices say, (B,).

        Args:
            states: States, (B, n).
            actions: Actions, (B, m).
            parameters: Parameters of the plant, (n_p,).
        """

        def costs_of(part: slice) -> Array:
            arguments, shape = self._arguments(states[part], actions[part])
            x, u, d, _ = arguments
            (stage_cost,) = self._cost(x, u, d, parameters)
            return _mean(np.broadcast_to(stage_cost, shape), self._weights)

        return np.concatenate(list(self._map(costs_of, len(states))))

    def _transition(self, x_next: Sequence[Array], grid: Grid) -> sparse.csr_array:
        """Weights of the grid's states (B, G) in the expectation of a function of s₊.

        Args:
            x_next: s₊ at the nodes, n arrays (B, q).
            grid: The grid.
        """
        from scipy import sparse  # noqa: PLC0415

        count, n_nodes = x_next[0].shape
        shape = (count, grid.size)
        row_numbers = np.arange(count)
        rows = np.repeat(row_numbers, n_nodes)
        # From state b to each corner of the cell that node q leads to: its probability times
        # the corner's weight. Entries of the same place add up.
        matrix = sparse.csr_array(shape)
        for index, weight in grid.weights(x_next):
            probabilities = weight * self._weights
            entries = probabilities.reshape(-1)
            columns = index.reshape(-1)
            places = (rows, columns)
            matrix += sparse.csr_array((entries, places), shape=shape)
        return matrix

    def _arguments(
        self,
        states: Array,
        actions: Array,
    ) -> tuple[tuple[Sequence[Array], ...], tuple[int, int]]:
        """Arguments of the model's functions, which broadcast, and the shape (B, q) of a result."""
        # States and actions (B, 1) with disturbances (1, q): all arrays broadcast to (B, q).
        arguments = (
            [column[:, None] for column in states.T],
            [column[:, None] for column in actions.T],
            self._disturbance,
            list(self._parameters),
        )
        return arguments, (len(states), len(self._weights))

    def _next_states(
        self,
        arguments: Sequence[Sequence[Array]],
        shape: tuple[int, int],
    ) -> list[Array]:
        """s₊ at the nodes, n arrays (B, q)."""
        next_entries = self._step(*arguments)
        return [np.broadcast_to(entry, shape) for entry in next_entries]

    def _expected_cost(
        self,
        states: Array,
        actions: Array,
    ) -> tuple[Array, list[Array]]:
        """E[ℓ + penalty(s₊)], shape (B,), and s₊ at the nodes, n arrays (B, q)."""
        arguments, shape = self._arguments(states, actions)
        x_next = self._next_states(arguments, shape)
        (stage_cost,) = self._cost(*arguments)
        at_nodes = np.broadcast_to(stage_cost, shape)
        cost = _mean(at_nodes, self._weights)
        penalty = self._expected_penalty(x_next)
        return cost + penalty, x_next

    def _expected_penalty(self, x_next: Sequence[Array]) -> Array:
        """E[penalty(s₊)], shape (B,), of s₊ at the nodes, n arrays (B, q)."""
        problem = self.problem
        total = np.zeros(len(x_next[0]))
        for i, x in enumerate(x_next):
            lowest = x.min(axis=1)
            highest = x.max(axis=1)
            # The outermost Gauss nodes lie inside the law's support.
            spread = highest - lowest
            reach = 0.25 * spread
            room_below = lowest - reach - problem.state_lower[i]
            room_above = highest + reach - problem.state_upper[i]
            # Only states that may violate a bound are worth the many nodes of the penalty.
            below = np.flatnonzero(room_below < 0)
            above = np.flatnonzero(room_above > 0)
            if len(below):
                penalty = self._expected_bound_penalty(x[below], i, -1.0)
                total[below] += penalty
            if len(above):
                penalty = self._expected_bound_penalty(x[above], i, 1.0)
                total[above] += penalty
        return total

    def _expected_bound_penalty(
        self,
        x: Array,
        i: int,
        sign: float,
    ) -> Array:
        """Expected penalty of one bound of state i, whose values are x (B, q) at the nodes.

        The bound is the upper one for `sign` 1, the lower one for −1. A state is smooth in the
        disturbances, so it is carried to the many nodes that the penalty's kink needs.
        """
        problem = self.problem
        bounds = problem.state_upper if sign > 0 else problem.state_lower
        linear = problem.penalty_linear[i]
        quadratic = problem.penalty_quadratic[i]
        at_penalty_nodes = self._refine(x)
        beyond = at_penalty_nodes - bounds[i]
        # `Penalty` of the scenario, for one bound.
        violation = np.maximum(sign * beyond, 0.0)
        price = linear + quadratic * violation
        return _mean(price * violation, self._penalty_weights)

    def _map(self, task: Callable[[slice], T], count: int) -> Iterator[T]:
        """Results of a task for slices of `count` states, by the threads where there are any."""
        n_nodes = len(self._weights)
        entries = count * n_nodes
        wanted = ceil(entries / ENTRIES_A_TASK)
        n_tasks = min(wanted, count)
        # Parts of nearly equal size, which do not depend on the number of threads.
        edges = np.linspace(0, count, n_tasks + 1)
        whole_edges = edges.astype(int).tolist()
        parts = []
        for start, stop in pairwise(whole_edges):
            parts.append(slice(start, stop))
        if self._pool is None:
            return map(task, parts)
        return self._pool.map(task, parts)


def _mean(values: Array, weights: Array) -> Array:
    """Weighted mean of each row, without BLAS, whose threads would compete with ours."""
    return np.asarray(np.einsum("bq,q->b", values, weights))


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
    size_of_x = (count, problem.n_states)
    size_of_u = (count, problem.n_actions)
    span = state_upper - state_lower
    reach = 0.25 * span
    lower = np.maximum(state_lower, reference - reach)
    upper = np.minimum(state_upper, reference + reach)
    x = generator.uniform(lower, upper, size_of_x)
    u = generator.uniform(problem.action_lower, problem.action_upper, size_of_u)
    d = plant.law.draw(generator, count)
    allowed = tolerance * (1 + np.abs(x))

    before = np.full_like(x, np.inf)
    for substeps in (1, 2, 4, 8, 16, 32, 64, 128):
        step = Elementwise(plant.sampled(substeps))
        # A step that is too long may overflow; then the next one is tried.
        with np.errstate(all="ignore"):
            entries = step(x.T, u.T, d.T, plant.parameters)
            # A state that depends on no other may be one number.
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
