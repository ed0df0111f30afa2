"""The Bellman operator of a scenario's stochastic plant on a state grid."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from controllers.dynamic_programming.grid import Grid
from controllers.errors import ModelError, OptimumError
from controllers.model import discretise, economic_cost
from controllers.problem import Problem, load_model
from cosim.protocols import Array, Vector
from cosim.scenario import Scenario


@dataclass(frozen=True)
class DisturbanceLaw:
    """Independent disturbances, drawn anew each sample and held over it.

    `uniform`: `nominal` ± `ranges`; `normal`: mean `nominal`, standard deviations `ranges`; `none`:
    always nominal. Both arrays have shape (n_d,).
    """

    kind: Literal["uniform", "normal", "none"]
    nominal: Array
    ranges: Array

    @property
    def deterministic(self) -> bool:
        """Whether the disturbances never leave their nominal values."""
        return self.kind == "none" or not self.ranges.any()

    def draw(self, generator: np.random.Generator, count: int) -> Array:
        """Draw `count` independent disturbances, shape (count, n_d)."""
        size = (count, len(self.nominal))
        if self.kind == "uniform":
            return self.nominal + self.ranges * generator.uniform(-1.0, 1.0, size)
        if self.kind == "normal":
            return self.nominal + self.ranges * generator.standard_normal(size)
        return np.tile(self.nominal, (count, 1))

    def rule(self, counts: tuple[int, ...]) -> ProductRule:
        """Gauss rule with the given number of nodes per disturbance.

        Gauss–Legendre for the uniform law, Gauss–Hermite for the normal one; a disturbance that
        does not vary takes one node. Exact for polynomials of degree 2·count−1 in each.
        """
        axes, weights = [], np.ones(1)
        for count, nominal, spread in zip(counts, self.nominal, self.ranges, strict=True):
            if self.kind == "none" or spread == 0:
                x, w = np.zeros(1), np.ones(1)
            elif self.kind == "uniform":
                x, w = np.polynomial.legendre.leggauss(count)
            else:
                x, w = np.polynomial.hermite_e.hermegauss(count)
            axes.append(nominal + spread * x)
            weights = np.multiply.outer(weights, w / w.sum()).reshape(-1)
        mesh = [axis.reshape(-1) for axis in np.meshgrid(*axes, indexing="ij")]
        return ProductRule(axes, np.stack(mesh, axis=1) if mesh else np.zeros((1, 0)), weights)


class ProductRule(NamedTuple):
    """A product quadrature rule: E[g(d)] ≈ Σ_i weights_i g(nodes_i).

    `axes` holds the nodes of each disturbance; `nodes` (q, n_d) all of them, the last disturbance
    running fastest, and `weights` (q,) have the sum 1.
    """

    axes: list[Array]
    nodes: Array
    weights: Array


class Refinement:
    """Values at one product rule's nodes carried to another's by polynomial interpolation.

    A smooth function known at few Gauss nodes is known everywhere to spectral accuracy; what is
    not smooth is then applied on the finer rule without evaluating the function anew.
    """

    def __init__(self, coarse: ProductRule, fine: ProductRule) -> None:
        self.weights = fine.weights
        axes = zip(coarse.axes, fine.axes, strict=True)
        self._matrices = [lagrange_matrix(nodes, targets) for nodes, targets in axes]
        # Products of tiny matrices cost more in calls than in arithmetic: join the last axes.
        while len(self._matrices) > 1 and self._matrices[-1].shape[1] < 4:
            last = self._matrices.pop()
            self._matrices[-1] = np.kron(self._matrices[-1], last).astype(np.float64)

    def __call__(self, values: Array) -> Array:
        """Carry values (B, q_coarse) to (B, q_fine)."""
        count, right = len(values), 1
        for matrix in reversed(self._matrices):
            fine, coarse = matrix.shape
            if right == 1:
                values = values.reshape(count, -1, coarse) @ matrix.T
            else:
                values = matrix @ values.reshape(-1, coarse, right)
            right *= fine
        return values.reshape(count, -1)


def lagrange_matrix(nodes: ArrayLike, targets: ArrayLike) -> Array:
    """Matrix (len(targets), len(nodes)) of the Lagrange polynomials of `nodes` at `targets`."""
    x, t = np.asarray(nodes, dtype=np.float64), np.asarray(targets, dtype=np.float64)
    matrix = np.ones((len(t), len(x)))
    for j in range(len(x)):
        for k in range(len(x)):
            if k != j:
                matrix[:, j] *= (t - x[k]) / (x[j] - x[k])
    return matrix


MEND = 'name the plant\'s own model as model = "module:factory" in the table [plant]'


@dataclass(frozen=True)
class PlantProblem:
    """The control problem with the plant's own model, and what is random in it.

    `parameters` (n_p,) are the plant's physical ones.
    """

    problem: Problem
    law: DisturbanceLaw
    parameters: Vector

    @classmethod
    def from_scenario(
        cls,
        scenario: Scenario,
        overrides: Mapping[str, float | None] | None = None,
    ) -> PlantProblem:
        """What a scenario says of its plant; `overrides` replaces plant parameters by name.

        One that is overridden by None is left out. The plant's model is `plant.model`, where the
        scenario names one, else the controller's. Raises OptimumError where it does not fit the
        plant, ModelError where it cannot be loaded.
        """
        problem = Problem.from_scenario(scenario)
        plant, table = scenario.plant, scenario.disturbance
        if plant.model is not None:
            problem = replace(problem, model=load_model(plant.model))
        model, needed = problem.model, "the optimum needs a model of the plant"
        for kind in ("states", "actions", "disturbances"):
            ours = [quantity.name for quantity in getattr(model, kind)]
            if ours != (theirs := list(getattr(plant, kind))):
                raise OptimumError(
                    f"{needed}: model '{model.name}' has the {kind} {', '.join(ours)}, the plant "
                    f"{', '.join(theirs)}; {MEND}"
                )
        nominal = np.array(table.nominal if len(table.nominal) else model.nominal_disturbance)
        ranges = np.array(table.ranges if len(table.ranges) else np.zeros(len(nominal)))
        parameters = {quantity.name: quantity.nominal for quantity in model.parameters}
        for name, value in {**plant.parameters, **(overrides or {})}.items():
            if value is None:
                continue
            if name not in parameters:
                raise OptimumError(
                    f"{needed}: plant.parameters sets '{name}', which model '{model.name}' does "
                    f"not have: give the model that parameter, {MEND}, or, where it only shapes "
                    "the noise, name it in plant.mapping.ranges and set disturbance.ranges"
                )
            parameters[name] = value
        law = DisturbanceLaw(table.law, nominal, ranges)
        return cls(problem, law, np.array([*parameters.values()], dtype=np.float64))


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
    ca.OP_FABS: np.abs,
    ca.OP_LT: lambda a, b: np.where(a < b, 1.0, 0.0),
    ca.OP_LE: lambda a, b: np.where(a <= b, 1.0, 0.0),
    ca.OP_EQ: lambda a, b: np.where(a == b, 1.0, 0.0),
    ca.OP_NE: lambda a, b: np.where(a != b, 1.0, 0.0),
    ca.OP_NOT: lambda a: np.where(a == 0, 1.0, 0.0),
    ca.OP_AND: lambda a, b: np.where((a != 0) & (b != 0), 1.0, 0.0),
    ca.OP_OR: lambda a, b: np.where((a != 0) | (b != 0), 1.0, 0.0),
    ca.OP_IF_ELSE_ZERO: lambda a, b: np.where(a != 0, b, 0.0),
    **{
        getattr(ca, f"OP_{name.upper()}"): getattr(np, name)
        for name in (
            *("exp", "log", "log1p", "expm1", "sqrt", "hypot", "sign", "floor", "ceil"),
            *("sin", "cos", "tan", "sinh", "cosh", "tanh", "fmin", "fmax"),
        )
    },
    **{
        getattr(ca, f"OP_A{name.upper()}"): getattr(np, f"arc{name}")
        for name in ("sin", "cos", "tan", "tan2")
    },
}


class Elementwise:
    """An SX function f(x, u, …) → y that takes and returns lists of arrays, broadcast as usual.

    Each argument is a sequence with one array per scalar entry; the result is the list of the
    first output's entries. CasADi's own `map` runs one interpreter pass per point; here each
    operation runs over all points, five to ten times faster on large arrays. Raises ModelError
    on an operation that has no NumPy counterpart here.
    """

    def __init__(self, function: ca.Function) -> None:
        self._n_work = function.sz_w()
        self._n_out = function.size1_out(0)
        self._out_rows = list(function.sparsity_out(0).row())
        self._program: list[tuple[int, Callable[..., Any] | None, tuple[Any, ...], Any]] = []
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            inputs = tuple(function.instruction_input(k))
            outputs = function.instruction_output(k)
            if code == ca.OP_CONST:
                self._program.append((code, None, (function.instruction_constant(k),), outputs[0]))
            elif code in {ca.OP_INPUT, ca.OP_OUTPUT}:
                self._program.append((code, None, inputs, tuple(outputs)))
            elif code in _OPERATIONS:
                self._program.append((code, _OPERATIONS[code], inputs, outputs[0]))
            else:
                raise ModelError(
                    f"function '{function.name()}': operation {code} of CasADi cannot be "
                    "evaluated over arrays; write the model without it"
                )

    def __call__(self, *arguments: Any) -> list[Any]:
        """Evaluate; `arguments[i][j]` is entry j of argument i."""
        work: list[Any] = [0.0] * self._n_work
        result: list[Any] = [0.0] * self._n_out
        for code, operation, inputs, output in self._program:
            if operation is not None:
                work[output] = operation(*[work[i] for i in inputs])
            elif code == ca.OP_CONST:
                work[output] = inputs[0]
            elif code == ca.OP_INPUT:
                work[output[0]] = arguments[inputs[0]][inputs[1]]
            elif output[0] == 0:
                result[self._out_rows[output[1]]] = work[inputs[0]]
        return result


T = TypeVar("T")
# Entries of an array, states × quadrature nodes, worked on at once: fewer leave two threads
# waiting for the interpreter's lock between short operations, more leave the cores' caches.
_ENTRIES = 100_000


@dataclass(frozen=True)
class Accuracy:
    """How the stochastic plant is evaluated: integrator and quadrature.

    `substeps` RK4 steps a sample; `nodes` Gauss nodes per disturbance for all that is smooth;
    `penalty_nodes` for the expected penalty, whose kink lies where the policy operates.
    """

    substeps: int
    nodes: tuple[int, ...]
    penalty_nodes: tuple[int, ...]

    def draft(self) -> Accuracy:
        """A quarter of the work, for a first grid whose only use is as a start."""
        return Accuracy(
            max(self.substeps // 2, 1),
            tuple(min(count, 5) for count in self.nodes),
            tuple(min(count, 10) for count in self.penalty_nodes),
        )

    def finer(self) -> Accuracy:
        """Half the integration step, two more nodes a disturbance, half as many again for the kink.

        A disturbance that is integrated with one node keeps it.
        """
        return Accuracy(
            2 * self.substeps,
            tuple(count + 2 if count > 1 else 1 for count in self.nodes),
            tuple(count + (count + 1) // 2 if count > 1 else 1 for count in self.penalty_nodes),
        )


class BellmanOperator:
    """Q(s, a) = E[ℓ(s, a, d) + penalty(s₊) + W(s₊)] with V = penalty + W.

    The penalty's kink is known in closed form, so only the smooth W is interpolated. `workers`
    threads share the blocks of states, whose results do not depend on their number.
    """

    def __init__(self, plant: PlantProblem, accuracy: Accuracy, *, workers: int = 1) -> None:
        problem, law = plant.problem, plant.law
        self.problem, self.deterministic = problem, law.deterministic
        self.accuracy = accuracy
        self._step = Elementwise(
            discretise(problem.model, problem.sampling_time, accuracy.substeps)
        )
        self._cost = Elementwise(economic_cost(problem.model))
        self._parameters = plant.parameters
        rule = law.rule(accuracy.nodes)
        self._weights = rule.weights
        self._disturbance = [rule.nodes[None, :, i] for i in range(rule.nodes.shape[1])]
        self._refine = Refinement(rule, law.rule(accuracy.penalty_nodes))
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None

    def deviation(self, state: Array, action: Array) -> Array:
        """Standard deviation of the next state from (state, action), shape (n,)."""
        _, x_next = self._expected_cost(state[None, :], action[None, :])
        x = np.concatenate(x_next)
        variance = (x * x) @ self._weights - (x @ self._weights) ** 2
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def values(self, states: Array, actions: Array, grid: Grid, W: Array) -> Array:
        """Q at states (B, n) and actions (B, m) for W (G,) on the grid; shape (B,)."""

        smooth = grid.interpolant(W)

        def block(part: slice) -> Array:
            cost, x_next = self._expected_cost(states[part], actions[part])
            return cost + _mean(smooth(x_next), self._weights)

        return np.concatenate(list(self._map(block, len(states))))

    def chain(self, actions: Array, grid: Grid) -> tuple[sparse.csr_array, Array]:
        """Markov chain of a policy (G, m) on the grid: transition matrix (G, G), cost (G,).

        The cost is E[ℓ + penalty(s₊)].
        """

        def block(part: slice) -> tuple[sparse.csr_array, Array]:
            cost, x_next = self._expected_cost(grid.points[part], actions[part])
            count, nodes = x_next[0].shape
            rows = np.repeat(np.arange(count), nodes)
            matrix = sparse.csr_array((count, grid.size))
            for index, weight in grid.weights(x_next):
                data = (weight * self._weights).reshape(-1)
                matrix += sparse.csr_array(
                    (data, (rows, index.reshape(-1))), shape=(count, grid.size)
                )
            return matrix, cost

        blocks = list(self._map(block, grid.size))
        matrix = sparse.vstack([part for part, _ in blocks], format="csr")
        return matrix, np.concatenate([cost for _, cost in blocks])

    def _expected_cost(self, states: Array, actions: Array) -> tuple[Array, list[Array]]:
        """E[ℓ + penalty(s₊)], shape (B,), and s₊ at the nodes, n arrays (B, q)."""
        arguments = (
            [column[:, None] for column in states.T],
            [column[:, None] for column in actions.T],
            self._disturbance,
            self._parameters,
        )
        shape = (len(states), len(self._weights))
        x_next = [np.broadcast_to(entry, shape) for entry in self._step(*arguments)]
        cost = _mean(np.broadcast_to(self._cost(*arguments)[0], shape), self._weights)
        return cost + self._expected_penalty(x_next), x_next

    def _expected_penalty(self, x_next: Sequence[Array]) -> Array:
        total = np.zeros(len(x_next[0]))
        problem = self.problem
        for i, x in enumerate(x_next):
            lowest, highest = x.min(axis=1), x.max(axis=1)
            # The outermost Gauss nodes lie inside the law's support.
            reach = 0.25 * (highest - lowest)
            for sign, extreme, bound in (
                (-1.0, lowest - reach, problem.state_lower[i]),
                (1.0, highest + reach, problem.state_upper[i]),
            ):
                near = np.flatnonzero(sign * (extreme - bound) > 0)
                if len(near):
                    violation = np.maximum(sign * (self._refine(x[near]) - bound), 0.0)
                    penalty = (
                        problem.penalty_linear[i] + problem.penalty_quadratic[i] * violation
                    ) * violation
                    total[near] += _mean(penalty, self._refine.weights)
        return total

    def _map(self, task: Callable[[slice], T], count: int) -> Iterator[T]:
        blocks = -(-count * len(self._weights) // _ENTRIES)
        edges = np.linspace(0, count, min(blocks, count) + 1).astype(int)
        parts = [slice(start, stop) for start, stop in pairwise(edges.tolist())]
        return self._pool.map(task, parts) if self._pool else map(task, parts)


def _mean(values: Array, weights: Array) -> Array:
    """Weighted mean of each row, without BLAS, whose own threads would compete with the blocks'."""
    return np.asarray(np.einsum("bq,q->b", values, weights))
