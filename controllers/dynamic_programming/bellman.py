"""The Bellman operator of the stochastic plant on a state grid."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from controllers.dynamic_programming.elementwise import Elementwise
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.plant import PlantProblem
from controllers.dynamic_programming.quadrature import Refinement
from controllers.model import discretise, economic_cost

Array = NDArray[np.float64]
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
    """Q(s, a) = E[ℓ(s, a, d) + γ penalty(s₊) + γ W(s₊)] with V = penalty + W.

    The penalty's kink is known in closed form, so only the smooth W is interpolated. γ = 1
    for the average-cost criterion. `workers` threads share the blocks of states, whose results do
    not depend on their number.
    """

    def __init__(
        self,
        plant: PlantProblem,
        accuracy: Accuracy,
        *,
        discount: float = 1.0,
        workers: int = 1,
    ) -> None:
        problem, law = plant.problem, plant.law
        self.problem, self.deterministic = problem, law.deterministic
        self.discount = discount
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
        deviation: Array = np.sqrt(np.maximum(variance, 0.0))
        return deviation

    def values(self, states: Array, actions: Array, grid: Grid, W: Array) -> Array:
        """Q at states (B, n) and actions (B, m) for W (G,) on the grid; shape (B,)."""

        smooth = grid.interpolant(W)

        def block(part: slice) -> Array:
            cost, x_next = self._expected_cost(states[part], actions[part])
            return cost + self.discount * _mean(smooth(x_next), self._weights)

        return np.concatenate(list(self._map(block, len(states))))

    def chain(self, actions: Array, grid: Grid) -> tuple[sparse.csr_array, Array]:
        """Markov chain of a policy (G, m) on the grid: transition matrix (G, G), cost (G,).

        The cost is E[ℓ + γ penalty(s₊)].
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
        """E[ℓ + γ penalty(s₊)], shape (B,), and s₊ at the nodes, n arrays (B, q)."""
        arguments = (
            [column[:, None] for column in states.T],
            [column[:, None] for column in actions.T],
            self._disturbance,
            self._parameters,
        )
        shape = (len(states), len(self._weights))
        x_next = [np.broadcast_to(entry, shape) for entry in self._step(*arguments)]
        cost = _mean(np.broadcast_to(self._cost(*arguments)[0], shape), self._weights)
        return cost + self.discount * self._expected_penalty(x_next), x_next

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
    mean: Array = np.einsum("bq,q->b", values, weights)
    return mean
