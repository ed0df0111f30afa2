"""Replay: transitions kept with their linearisation points and judged again at the present θ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.errors import QpError
from controllers.rti.prepared import LinearisationPoint
from learning.average_cost import AverageCost
from learning.protocols import LearnableController, LearnableSolution, Transition

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
POINT = tuple(f"point_{name}" for name in LinearisationPoint._fields)
NEXT_POINT = tuple(f"next_{name}" for name in POINT)
COLUMNS = ("number", "s", "a", "explored", "cost", "next_s", *POINT, *NEXT_POINT)


@dataclass(frozen=True)
class Replayed:
    """K transitions at one θ: `action_value` Q(s, a), `target` ℓ + γV(s₊), both (K,).

    `number` says which samples they are; `gradient` ∇Q and `next_gradient` ∇V(s₊), (K, n_θ), are
    in θ itself. Transitions whose QP failed at this θ are left out; `failures` counts them.
    """

    number: NDArray[np.int64]
    action_value: Vector
    target: Vector
    gradient: Matrix
    next_gradient: Matrix
    failures: int

    @property
    def td_error(self) -> Vector:
        """δ = ℓ + γV(s₊) − Q(s, a), (K,)."""
        return self.target - self.action_value


class ReplayBuffer:
    """The last `capacity` transitions; the linearisation point belongs to a transition.

    Under real-time iterations V and Q depend on the guess at which the QP is linearised, so a
    replay linearises where the plant's loop did, with the model and cost of the present θ.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._columns: dict[str, NDArray[Any]] = {}
        self._added = 0

    def __len__(self) -> int:
        """Number of transitions kept."""
        return min(self._added, self._capacity)

    def add(self, transition: Transition) -> None:
        """Keep a transition in place of the oldest one."""
        point, next_point = transition.point, transition.next_point
        assert point is not None and next_point is not None
        row = (
            *(transition.number, transition.s, transition.a, transition.explored),
            *(transition.cost, transition.next_s, *point, *next_point),
        )
        if not self._columns:
            kept = zip(COLUMNS, map(np.asarray, row), strict=True)
            self._columns = {
                name: np.empty((self._capacity, *value.shape), value.dtype) for name, value in kept
            }
        position = self._added % self._capacity
        for name, value in zip(COLUMNS, row, strict=True):
            self._columns[name][position] = value
        self._added += 1

    def replay(self, controller: LearnableController, average_cost: AverageCost) -> Replayed:
        """Solve for Q(s, a) and V(s₊) of every transition at the controller's θ, in time's order.

        A successor shares the linearisation, and where it was greedy the solution too: V(s₊) of one
        transition is Q of the next.
        """
        columns, size = self._columns, controller.theta.size
        count = len(self)
        order = (np.arange(count) + max(self._added - self._capacity, 0)) % self._capacity
        q, target = np.full(count, np.nan), np.full(count, np.nan)
        gradient, next_gradient = np.zeros((count, size)), np.zeros((count, size))
        at: int | None = None
        value: LearnableSolution | None = None
        # Plain numbers: reading them one by one out of arrays costs as much as a gradient.
        numbers, explored, cost = (
            columns[n][order].tolist() for n in ("number", "explored", "cost")
        )
        points, next_points = ([columns[name] for name in names] for names in (POINT, NEXT_POINT))
        for k, row in enumerate(order.tolist()):
            try:
                if at != numbers[k]:
                    controller.prepare_at(LinearisationPoint(*(part[row] for part in points)))
                    value = None
                if explored[k]:
                    value = controller.feedback(columns["s"][row], columns["a"][row])
                elif value is None:
                    value = controller.feedback(columns["s"][row])
                q[k], gradient[k] = value.value, value.value_gradient
                controller.prepare_at(LinearisationPoint(*(part[row] for part in next_points)))
                at, value = numbers[k] + 1, controller.feedback(columns["next_s"][row])
                target[k] = average_cost.target(cost[k], value.value)
                next_gradient[k] = value.value_gradient
            except QpError:
                at = None
        kept = np.isfinite(q) & np.isfinite(target)
        return Replayed(
            columns["number"][order[kept]],
            q[kept],
            target[kept],
            gradient[kept],
            next_gradient[kept],
            int(count - kept.sum()),
        )

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything kept, as arrays."""
        return {"added": np.array(self._added), **{k: v.copy() for k, v in self._columns.items()}}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._added = int(state["added"])
        self._columns = {name: values for name, values in state.items() if name != "added"}
