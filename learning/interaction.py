"""The loop of plant, controller and exploration that learning takes its samples from."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.errors import QpError
from controllers.rti.prepared import LinearisationPoint
from cosim.protocols import recover
from learning.exploration import Strategy
from learning.protocols import (
    Algorithm,
    ContinuablePlant,
    LearnableController,
    LearnableSolution,
    Transition,
)

Vector = NDArray[np.float64]
CHECKED_EVERY = 10
"""The flags of a solution cost as much as a feedback; of this many samples one pays for them."""
COUNTS = ("number", "failures", "explored", "saturated", "weakly_active", "licq_failed")


class Interaction:
    """One long episode in which V(s₊) of a sample is V(s) of the next, so a sample costs one QP.

    `next` gives a sample, or None where the controller failed: then the last applied action is
    applied once more, `failures` counts it and the controller starts from its reference.
    `weakly_active` and `licq_failed` count, of every tenth sample, the policies whose derivatives
    are one-sided and those whose active constraints are linearly dependent. After `rest_after`
    samples nothing explores (`rests`).
    """

    def __init__(
        self,
        plant: ContinuablePlant,
        controller: LearnableController,
        algorithm: Algorithm,
        strategy: Strategy,
        rng: np.random.Generator,
        rest_after: int | None = None,
    ) -> None:
        scenario = plant.scenario
        self._rest_after = inf if rest_after is None else rest_after
        self._plant, self._controller, self._rng = plant, controller, rng
        self._strategy, self._algorithm = strategy, algorithm
        self._lower, self._upper = scenario.action_lower, scenario.action_upper
        self._penalty, self._saturate = scenario.state_penalty, scenario.saturate
        self._applied = scenario.reference_action
        self._policy: LearnableSolution | None = None
        self._point: LinearisationPoint | None = None
        self.s: Vector = scenario.initial_state
        self._marked: tuple[Any, Vector, LinearisationPoint | None] | None = None
        self.number = 0
        self.failures = 0
        self.explored = 0
        self.saturated = 0
        self.weakly_active = 0
        self.licq_failed = 0

    def start(self, seed: int) -> None:
        """Begin the episode: reset plant and controller, solve for the first state."""
        self.s = self._plant.reset(seed)
        self._controller.reset()
        self._policy = self._solve()

    @property
    def rests(self) -> bool:
        """Whether exploration and learning are over, and the rest is for the record."""
        return self.number >= self._rest_after

    def mark(self) -> None:
        """Remember the plant as it is now; raises CapabilityError where it cannot be."""
        self._marked = (self._plant.snapshot(), self.s, self._point)

    def rewind(self) -> None:
        """Put plant and guess back to where they were remembered, and solve there."""
        assert self._marked is not None
        snapshot, self.s, self._point = self._marked
        self._plant.restore(snapshot)
        self.restart()

    def next(self) -> tuple[Transition | None, float]:
        """One sample of the plant; returns it, or None after a failure, and its cost."""
        policy, point, s, number = self._policy, self._point, self.s, self.number
        a, explored = (self._applied, False) if policy is None else self._choose(policy.action)
        action_value = policy
        if explored and self._algorithm.needs_action_value:
            action_value = self._action_value(s, a)
        if policy is not None and number % CHECKED_EVERY == 0:
            self.weakly_active += policy.weakly_active
            self.licq_failed += not policy.licq
        step = self._plant.step(a)
        self._applied, self.s, self.number = a, step.s, number + 1
        self._policy = self._solve()
        cost = step.stage_cost + step.penalty
        if policy is None or action_value is None or self._policy is None:
            return None, cost
        keep = self._algorithm.needs_points
        return Transition(
            number=number,
            s=s,
            a=a,
            explored=explored,
            policy=policy,
            action_value=action_value,
            stage_cost=step.stage_cost,
            cost=cost,
            next_s=self.s,
            next_penalty=self._penalty(self.s.tolist()),
            next_policy=self._policy,
            point=point if keep else None,
            next_point=self._point if keep else None,
        ), cost

    def _choose(self, action: Vector) -> tuple[Vector, bool]:
        """The action to apply, (m,), within the actuators' bounds, and whether it explores."""
        if self.rests or not getattr(self._algorithm, "explores", True):
            return self._saturate(action), False
        try:
            explored = self._strategy(action, self._rng, self.number, self._perturbed)
        except QpError:  # of the perturbed cost; the policy itself was solved for
            self.failures += 1
            explored = None
        # The QP keeps bounds to its tolerance, the actuator exactly.
        if explored is None:
            return self._saturate(action), False
        a = self._saturate(explored)
        self.explored += 1
        self.saturated += bool(((a == self._lower) | (a == self._upper)).any())
        return a, True

    def renew(self) -> None:
        """Solve once more for the present state, at the guess as it was: θ has moved."""
        if self._point is None:
            return
        self._controller.prepare_at(self._point)
        self._policy = self._feedback()

    def restart(self) -> None:
        """Forget all that a solver may carry from sample to sample but the guess itself.

        Called at a checkpoint in the run that goes on as in the one that resumes, so that both
        see the same digits ever after.
        """
        point = self._point
        self._controller.reset()
        if point is None:
            self._policy = self._solve()
        else:
            self._controller.prepare_at(point)
            self._policy = self._feedback()

    def state(self) -> tuple[dict[str, int], dict[str, Vector]]:
        """Numbers and arrays from which `resume` goes on."""
        arrays = {"s": self.s, "applied": self._applied}
        arrays |= _stored("point", self._point)
        if self._marked is not None:
            content = self._plant.serialise(self._marked[0])
            arrays |= {"marked_s": self._marked[1], "marked": np.frombuffer(content, np.uint8)}
            arrays |= _stored("marked_point", self._marked[2])
        return {name: getattr(self, name) for name in COUNTS}, arrays

    def resume(self, numbers: dict[str, int], arrays: dict[str, Vector]) -> None:
        """Take back what `state` gave; the plant must have been restored before.

        Raises KeyError, TypeError or ValueError where it is not that.
        """
        for name in COUNTS:
            setattr(self, name, int(numbers[name]))
        self.s, self._applied = arrays["s"], arrays["applied"]
        self._point = self._marked = None
        if "marked" in arrays:
            snapshot = self._plant.deserialise(arrays["marked"].tobytes())
            self._marked = (snapshot, arrays["marked_s"], _point("marked_point", arrays))
        self._point = _point("point", arrays)
        self.restart()

    def _solve(self) -> LearnableSolution | None:
        """V(s) and π(s) at the present state, prepared anew."""

        def solve() -> LearnableSolution:
            self._controller.prepare()
            self._point = self._controller.linearisation_point
            return self._controller.feedback(self.s)

        return self._attempt(solve)

    def _feedback(self) -> LearnableSolution | None:
        """V(s) and π(s) at the present state, as prepared."""
        return self._attempt(lambda: self._controller.feedback(self.s))

    def _action_value(self, s: Vector, a: Vector) -> LearnableSolution | None:
        """Q(s, a) where the algorithm asks for it; moves the guess towards the applied action."""
        return self._attempt(lambda: self._controller.feedback(s, a))

    def _attempt(self, solve: Callable[[], LearnableSolution]) -> LearnableSolution | None:
        """What `solve` returns, or None where the controller fails, which is counted."""
        try:
            return solve()
        except Exception as error:
            recover(self._controller, error)
        self.failures += 1
        self._point = None
        return None

    def _perturbed(self, gradient: Vector) -> Vector:
        """π(s) of the cost with a linear term on the actions added to b_l."""
        controller, theta, point = self._controller, self._controller.theta, self._point
        assert point is not None
        where = controller.parameters.blocks.slices["b_l"]
        moved = theta.copy()
        moved[where.stop - gradient.size : where.stop] += gradient
        try:
            controller.theta = moved
            controller.prepare_at(point)
            return controller.feedback(self.s).action
        finally:
            controller.theta = theta
            controller.prepare_at(point)
            controller.feedback(self.s)


def _stored(name: str, point: LinearisationPoint | None) -> dict[str, Vector]:
    if point is None:
        return {}
    return {f"{name}_{key}": value for key, value in point._asdict().items()}


def _point(name: str, arrays: dict[str, Vector]) -> LinearisationPoint | None:
    if f"{name}_x" not in arrays:
        return None
    return LinearisationPoint(*(arrays[f"{name}_{key}"] for key in LinearisationPoint._fields))
