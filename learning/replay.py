"""Replay: transitions kept with their linearisation points and judged again at the present θ."""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.errors import QpError
from controllers.rti.prepared import LinearisationPoint
from learning.algorithm import LearnableController, LearnableSolution, Transition
from learning.checkpoint import group, prefixed
from learning.q_learning import AverageCost

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
POINT = tuple(f"point_{name}" for name in LinearisationPoint._fields)
NEXT_POINT = tuple(f"next_{name}" for name in POINT)
REMEMBERED = 2
"""The θ of the loop's samples and the one that a refused step goes back to."""
JUDGEMENTS = "judgements "
COLUMNS = ("number", "s", "a", "explored", "cost", "next_s", *POINT, *NEXT_POINT)


@dataclass(frozen=True)
class Replayed:
    """K transitions at one θ: `action_value` Q(s, a), `target` ℓ + γV(s₊), both (K,).

    `number` says which samples they are; `gradient` ∇Q, (K, n_θ), is in θ
    itself. Transitions whose QP failed at this θ are left out; `failures` counts them.
    """

    number: NDArray[np.int64]
    action_value: Vector
    target: Vector
    gradient: Matrix
    failures: int

    @property
    def td_error(self) -> Vector:
        """δ = ℓ + γV(s₊) − Q(s, a), (K,)."""
        return self.target - self.action_value


class Judgements:
    """What is known of a buffer's transitions at one `theta`, NaN where nothing is.

    `action_value` Q(s, a) and `next_value` V(s₊), (capacity,), and ∇Q in θ,
    (capacity, n_θ), which means nothing where the value is NaN.
    """

    def __init__(self, capacity: int, theta: Vector) -> None:
        self.theta = theta
        self.action_value, self.next_value = np.full((2, capacity), np.nan)
        self.gradient = np.zeros((capacity, theta.size))

    def begin(self, theta: Vector) -> None:
        """Know nothing, at another θ."""
        self.theta = theta
        self.action_value[:] = self.next_value[:] = np.nan

    def forget(self, row: int) -> None:
        """Know nothing of a row, which another transition takes."""
        self.action_value[row] = self.next_value[row] = np.nan

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything known, as arrays."""
        return {name: array.copy() for name, array in vars(self).items()}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        vars(self).update(state)


class ReplayBuffer:
    """The last `capacity` transitions; the linearisation point belongs to a transition.

    Under real-time iterations V and Q depend on the guess at which the QP is linearised, so a
    replay linearises where the plant's loop did, with the model and cost of the controller's θ.
    What was solved at one of the last `REMEMBERED` θ, by the loop or by a replay, is not solved
    again where the controller is `memoryless`.
    """

    def __init__(self, controller: LearnableController, capacity: int) -> None:
        self._controller, self._capacity = controller, capacity
        self._columns: dict[str, NDArray[Any]] = {}
        self._judgements: list[Judgements] = []
        self._added = 0

    def __len__(self) -> int:
        """Number of transitions kept."""
        return min(self._added, self._capacity)

    def add(self, transition: Transition) -> None:
        """Keep a transition, solved at the controller's θ, in place of the oldest one."""
        point, next_point = transition.point, transition.next_point
        assert point is not None and next_point is not None
        values = (
            *(transition.number, transition.s, transition.a, transition.explored),
            *(transition.cost, transition.next_s, *point, *next_point),
        )
        if not self._columns:
            kept = zip(COLUMNS, map(np.asarray, values), strict=True)
            self._columns = {
                name: np.empty((self._capacity, *value.shape), value.dtype) for name, value in kept
            }
        row = self._added % self._capacity
        for name, value in zip(COLUMNS, values, strict=True):
            self._columns[name][row] = value
        self._added += 1
        if not self._controller.memoryless:
            return
        known = self._at(self._controller.theta)
        for judgements in self._judgements:
            judgements.forget(row)
        known.next_value[row] = transition.next_policy.value
        if not transition.explored:
            known.action_value[row] = transition.policy.value
            known.gradient[row] = transition.policy.value_gradient

    def replay(self, average_cost: AverageCost) -> Replayed:
        """Q(s, a) and V(s₊) of every transition at the controller's θ, in time's order."""
        known, count = self._at(self._controller.theta), len(self)
        if not self._controller.memoryless:
            known.begin(known.theta)
        order = (np.arange(count) + max(self._added - self._capacity, 0)) % self._capacity
        unknown = np.isnan(known.action_value[order] + known.next_value[order])
        self._solve(known, order[unknown])
        target = average_cost.target(self._columns["cost"][order], known.next_value[order])
        kept = np.isfinite(known.action_value[order]) & np.isfinite(target)
        order, target = order[kept], target[kept]
        return Replayed(
            self._columns["number"][order],
            known.action_value[order],
            target,
            known.gradient[order],
            int(count - kept.sum()),
        )

    def _at(self, theta: Vector) -> Judgements:
        """What is known at a θ, in place of what is known at the one asked for longest ago."""
        found = next(
            (k for k in self._judgements if k.theta is theta or np.array_equal(k.theta, theta)),
            None,
        )
        if found is None:
            if len(self._judgements) < REMEMBERED:
                self._judgements.append(Judgements(self._capacity, theta))
            found = self._judgements[-1]
            found.begin(theta)
        found.theta = theta
        if self._judgements[0] is not found:
            self._judgements.remove(found)
            self._judgements.insert(0, found)
        return found

    def _solve(self, known: Judgements, rows: NDArray[np.int64]) -> None:
        """Solve for what is not known of these rows, which are in time's order.

        A successor shares the linearisation, and where it was greedy the solution too: V(s₊) of one
        transition is Q of the next. What a failing QP was to give stays NaN.
        """
        controller, columns = self._controller, self._columns
        at: int | None = None
        value: LearnableSolution | None = None
        # Plain numbers: reading them one by one out of arrays costs as much as a gradient.
        numbers, explored = (columns[name][rows].tolist() for name in ("number", "explored"))
        points, next_points = ([columns[name] for name in names] for names in (POINT, NEXT_POINT))
        for number, exploring, row in zip(numbers, explored, rows.tolist(), strict=True):
            try:
                if isnan(known.action_value[row]):
                    if at != number:
                        controller.prepare_at(LinearisationPoint(*(p[row] for p in points)))
                        value = None
                    if exploring:
                        value = controller.feedback(columns["s"][row], columns["a"][row])
                    elif value is None:
                        value = controller.feedback(columns["s"][row])
                    known.action_value[row] = value.value
                    known.gradient[row] = value.value_gradient
                if isnan(known.next_value[row]):
                    controller.prepare_at(LinearisationPoint(*(p[row] for p in next_points)))
                    at, value = number + 1, controller.feedback(columns["next_s"][row])
                    known.next_value[row] = value.value
            except QpError:
                at = None

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything kept, as arrays."""
        state = {"added": np.array(self._added), **{k: v.copy() for k, v in self._columns.items()}}
        for k, judgements in enumerate(self._judgements):
            state |= prefixed(f"{JUDGEMENTS}{k} ", judgements.state())
        return state

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._added = int(state["added"])
        self._columns = {name: state[name] for name in COLUMNS if name in state}
        self._judgements = []
        for k in range(REMEMBERED):
            if kept := group(state, f"{JUDGEMENTS}{k} "):
                self._judgements.append(Judgements(self._capacity, kept["theta"]))
                self._judgements[-1].restore(kept)
