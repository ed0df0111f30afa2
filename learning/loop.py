"""The training loop: plant, controller and learning rule, sample by sample, and its checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.rti import LinearisationPoint, RtiNmpc, RtiSolution
from controllers.theta import Parameters
from cosim.plant import FmuPlant
from cosim.protocols import Step, Vector
from cosim.simulation import recover
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import arrays_of, group, prefixed, take_up
from learning.configuration import Strategy
from learning.errors import PrivilegeError

CHECKED_EVERY = 10
"""The flags of a solution cost as much as a feedback; of this many samples one pays for them."""


class PlantInOperation:
    """What is left of a plant in operation: its next sample.

    It cannot be reset, put back, or told which noise to meet.
    """

    __slots__ = ("scenario", "step")

    def __init__(self, plant: FmuPlant) -> None:
        self.scenario = plant.scenario

        def step(a: Vector) -> Step:
            return plant.step(a)

        self.step = step


@dataclass
class Counts:
    """What a loop has counted since its start.

    `number` of samples; `failures` of the controller; samples that `explored`, and of these those
    `saturated` at an actuator's bound; of every tenth sample, the policies whose derivatives are
    one-sided, `weakly_active`, and those whose active constraints are dependent, `licq_failed`.
    """

    number: int = 0
    failures: int = 0
    explored: int = 0
    saturated: int = 0
    weakly_active: int = 0
    licq_failed: int = 0


class TrainingLoop:
    """Takes samples from a plant and lets a rule move the controller's θ.

    V(s₊) of a sample is V(s) of the next one, so a greedy sample costs one QP. Where the controller
    fails, the last action is applied once more, the failure is counted and the controller starts
    from its reference. After `rest_after` samples θ stays and nothing explores.

    `plant` has been reset. An algorithm that asks for `operation` has a `PlantInOperation` here: it
    gets transitions, and nothing else of the plant. `rng` draws the exploration; `algorithm_rng` is
    the algorithm's own and goes through checkpoints.
    """

    def __init__(
        self,
        plant: FmuPlant | PlantInOperation,
        controller: RtiNmpc,
        algorithm: Algorithm,
        strategy: Strategy,
        rng: np.random.Generator,
        rest_after: int | None = None,
        algorithm_rng: np.random.Generator | None = None,
    ) -> None:
        scenario = plant.scenario
        self._simulator: FmuPlant | None = None
        self._plant = plant
        if not isinstance(plant, PlantInOperation):
            simulator = algorithm.asks_for == "simulator"
            self._simulator = plant if simulator else None
            self._plant = plant if simulator else PlantInOperation(plant)
        self.controller, self.algorithm, self.rng = controller, algorithm, rng
        self._strategy = strategy
        self._generators = {"exploration": rng}
        if algorithm_rng is not None:
            self._generators["algorithm"] = algorithm_rng
        self.start_parameters = controller.parameters
        self._rest_after = inf if rest_after is None else rest_after
        self._lower, self._upper = scenario.action_lower, scenario.action_upper
        self._penalty = scenario.state_penalty
        self._applied = scenario.reference_action
        self._policy: RtiSolution | None = None
        self._point: LinearisationPoint | None = None
        self._marked: tuple[Any, Vector, LinearisationPoint | None] | None = None
        self.s: Vector = scenario.initial_state
        self.counts = Counts()

    def start(self, s: Vector) -> None:
        """Begin an episode at the state s (n,) to which the plant has been reset."""
        self.s = s
        self.controller.reset()
        self._policy = self._solve(self.s, prepare=True)

    @property
    def parameters(self) -> Parameters:
        """The θ to hand over now: the rule's reported θ, else its behaviour's."""
        theta = getattr(self.algorithm, "theta", None)
        present = self.controller.parameters
        return present if theta is None else present.with_theta(theta)

    @property
    def rests(self) -> bool:
        """Whether exploration and learning are over, and the rest is for the record."""
        return self.counts.number >= self._rest_after

    def advance(self) -> tuple[float, Update | None]:
        """One sample of plant and rule: its cost, and the update if θ moved.

        Raises DivergenceError where the rule finds that θ means nothing any more, PrivilegeError
        where it asks more of the plant than it stated.
        """
        rests = self.rests
        transition, cost = self.next()
        update: Update | None = None
        if transition is not None and not rests:
            update = self.algorithm.observe(transition)
        elif not rests and (failed := getattr(self.algorithm, "failed", None)):
            update = failed(cost)
        if update is None:
            return cost, None
        self.counts.failures += update.failures
        if update.mark:
            self._marked = (self._asked("mark").snapshot(), self.s, self._point)
        if update.rewind:
            plant = self._asked("rewind")
            if self._marked is None:
                raise PrivilegeError(f"{type(self.algorithm).__name__}: 'rewind' before any 'mark'")
            snapshot, self.s, self._point = self._marked
            plant.restore(snapshot)
            self.restart()
        elif update.episode is not None:
            self.start(self._asked("episode").reset(update.episode))
        else:
            self.renew()
        return cost, update

    def renew(self) -> None:
        """Solve once more for the present state, at the guess as it was: θ has moved."""
        if self._point is not None:
            self.controller.prepare_at(self._point)
            self._policy = self._solve(self.s)

    def next(self) -> tuple[Transition | None, float]:
        """One sample of the plant: its transition, None after a failure, and its cost."""
        policy, point, s, number = self._policy, self._point, self.s, self.counts.number
        a, explored = (self._applied, False) if policy is None else self._choose(policy.action)
        action_value = policy
        if explored and self.algorithm.needs_action_value:
            action_value = self._solve(s, a)
        if policy is not None and number % CHECKED_EVERY == 0:
            self.counts.weakly_active += policy.weakly_active
            self.counts.licq_failed += not policy.licq
        step = self._plant.step(a)
        for array in (s, a, step.s, step.disturbance):
            array.flags.writeable = False  # a rule reads what was measured, and changes nothing
        self._applied, self.s, self.counts.number = a, step.s, number + 1
        self._policy = self._solve(self.s, prepare=True)
        cost = step.stage_cost + step.penalty
        if policy is None or action_value is None or self._policy is None:
            return None, cost
        keep = self.algorithm.needs_points
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
        explored: Vector | None = None
        if not self.rests and getattr(self.algorithm, "explores", True):
            explored = self._strategy(action, self.rng)
        # The QP keeps bounds to its tolerance, the actuator exactly.
        a = np.clip(action if explored is None else explored, self._lower, self._upper)
        if explored is not None:
            self.counts.explored += 1
            self.counts.saturated += bool(((a == self._lower) | (a == self._upper)).any())
        return a, explored is not None

    def _asked(self, privilege: str) -> FmuPlant:
        """The plant as a simulator; raises PrivilegeError if not asked for."""
        if self._simulator is None:
            raise PrivilegeError(
                f"{type(self.algorithm).__name__} asks for a plant in operation, and its update "
                f"has '{privilege}', which only a simulator can; state asks_for = \"simulator\""
            )
        return self._simulator

    def _solve(
        self, s: Vector, a: Vector | None = None, *, prepare: bool = False
    ) -> RtiSolution | None:
        """V(s) and π(s), or Q(s, a); None after a failure, which is counted."""
        try:
            if prepare:
                self.controller.prepare()
                self._point = self.controller.linearisation_point
            return self.controller.feedback(s, a)
        except Exception as error:
            recover(self.controller, error)
        self.counts.failures += 1
        self._point = None
        return None

    def restart(self) -> None:
        """Forget all that a solver may carry from sample to sample but the guess itself.

        Called at a checkpoint in the run that goes on as in the one that resumes, so that both
        see the same digits ever after.
        """
        self.controller.reset()
        if self._point is None:
            self._policy = self._solve(self.s, prepare=True)
        else:
            self.renew()

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """JSON-ready values and arrays from which `restore` goes on; the plant's are the run's."""
        arrays = {"s": self.s, "applied": self._applied, **_stored("point", self._point)}
        if self._marked is not None:
            content = self._asked("mark").serialise(self._marked[0])
            arrays |= {"marked_s": self._marked[1], "marked": np.frombuffer(content, np.uint8)}
            arrays |= _stored("marked_point", self._marked[2])
        values = {name: rng.bit_generator.state for name, rng in self._generators.items()}
        stored = {"theta": self.controller.theta, **prefixed("loop ", arrays)}
        stored |= prefixed("counts ", arrays_of(self.counts))
        return values, stored | prefixed("algorithm ", self.algorithm.state())

    def restore(self, values: dict[str, Any], stored: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave; the plant must have been restored before.

        Raises KeyError, TypeError, ValueError or another error where it is not that.
        """
        for name, rng in self._generators.items():
            rng.bit_generator.state = values[name]
        self.controller.theta = stored["theta"]
        self.algorithm.restore(group(stored, "algorithm "))
        take_up(self.counts, group(stored, "counts "))
        arrays = group(stored, "loop ")
        self.s, self._applied = arrays["s"], arrays["applied"]
        self._marked = None
        if "marked" in arrays:
            snapshot = self._asked("mark").deserialise(arrays["marked"].tobytes())
            self._marked = (snapshot, arrays["marked_s"], _point("marked_point", arrays))
        self._point = _point("point", arrays)
        self.restart()


def _stored(name: str, point: LinearisationPoint | None) -> dict[str, Vector]:
    return {} if point is None else prefixed(f"{name}_", point._asdict())


def _point(name: str, arrays: dict[str, Vector]) -> LinearisationPoint | None:
    parts = group(arrays, f"{name}_")
    return LinearisationPoint(**parts) if parts else None
