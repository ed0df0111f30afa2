"""A learning rule, its requests to the plant, and the loop of plant, controller and rule.

An own rule inherits `Algorithm`, is given a `Transition` and returns an `Update`. `TrainingLoop`
draws the exploration and carries out an update's requests to the plant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from scipy.special import ndtr

from controllers.rti import LinearisationPoint, RtiNmpc, RtiSolution
from controllers.theta import Parameters
from cosim.modules import load_plugin
from cosim.plant import FmuPlant
from cosim.plugins import ALGORITHMS, registered
from cosim.protocols import Matrix, Plant, Step, Vector
from cosim.scenario import Scenario
from cosim.simulation import recover
from cosim.validation import suggestion
from learning.checkpoint import State, arrays_of, take_up
from learning.configuration import Configuration
from learning.errors import AlgorithmLookupError, ConfigurationError, PrivilegeError

Privilege = Literal["operation", "simulator"]
CHECKED_EVERY = 10
"""Samples between two checks of a solution's flags, which cost as much as a feedback."""


class Transition(NamedTuple):
    """One transition (s, a, ℓ, s₊), all at one θ; `number` counts from 0.

    `policy` is the solution for V(s) and π(s); `action_value` that for Q(s, a), the same object
    where the sample was greedy (then Q = V) or the algorithm does not need it; `next_policy` that
    for V(s₊), π(s₊). `next_s` is s₊; `explored` says that a is not π(s). `stage_cost` is ℓ, `cost`
    ℓ plus the penalty of s, the sample's share of J; `next_penalty` the penalty of s₊. `point` and
    `next_point` are the linearisation points at s and s₊, None unless the rule `needs_points`.
    """

    number: int
    s: Vector
    a: Vector
    explored: bool
    policy: RtiSolution
    action_value: RtiSolution
    stage_cost: float
    cost: float
    next_s: Vector
    next_penalty: float
    next_policy: RtiSolution
    point: LinearisationPoint | None
    next_point: LinearisationPoint | None


class Update(NamedTuple):
    """An update of θ: fields for the log, and requests to the plant.

    `td_error` is the root mean square TD error of the update's samples, `step` the norm of the
    scaled step, `smallest_eigenvalue` that of B_l and B_Vf at the new θ; `corrected` says that the
    step was changed to keep them definite, `refused` that it was not taken, or that the best
    back-off was the last one tried; `failures` counts the algorithm's own QPs that failed.

    The last three are for algorithms that ask for a simulator; PrivilegeError otherwise. `episode`
    resets the plant to the scenario's initial state with this seed of its noise. `mark` takes a
    snapshot of the plant, `rewind` restores it, with the same noise to come.
    """

    td_error: float
    step: float
    smallest_eigenvalue: float
    corrected: bool = False
    refused: bool = False
    failures: int = 0
    episode: int | None = None
    mark: bool = False
    rewind: bool = False


class Strategy:
    """Draws the actions that explore: a = sat(c + e), e ~ N(0, diag σ²), on a share of the samples.

    The centre c is the policy's action (`additive`) or zero (`literal`, as the paper prints it).
    `probability` is the share, `deviation` σ (m,) or (1,) in the actions' units. The loop saturates
    at `lower` and `upper` (m,). ConfigurationError on a wrong number of deviations.
    """

    def __init__(self, configuration: Configuration, scenario: Scenario) -> None:
        self.lower, self.upper = scenario.action_lower, scenario.action_upper
        self.deviation: Vector = configuration.exploration_share * (self.upper - self.lower)
        if configuration.exploration_deviation is not None:
            self.deviation = np.array(configuration.exploration_deviation)
        if self.deviation.size not in (1, self.lower.size):
            raise ConfigurationError(
                f"exploration_deviation has {self.deviation.size} entries; give one, or one for "
                f"each of the {self.lower.size} actions"
            )
        self.kind, greedy = configuration.exploration, configuration.exploration == "none"
        self.probability = 0.0 if greedy else configuration.exploration_probability

    def __call__(self, action: Vector, rng: np.random.Generator) -> Vector | None:
        """Exploring action (m,) in place of the policy's `action`; None: greedy."""
        # Draw in every sample, so that runs of any probability stay paired.
        draw, e = rng.random(), rng.standard_normal(self.lower.size)
        if draw >= self.probability:
            return None
        explored: Vector = self._centre(action) + self.deviation * e
        return explored

    def bias(self, actions: Matrix) -> Matrix:
        """E[a − π | explored] of samples with policies π, (K, m).

        The mean of the censored normal distribution less π; zero without saturation if the centre
        is π.
        """
        centres = self._centre(actions)
        sigma = np.maximum(self.deviation, np.finfo(float).tiny)
        low, high = (self.lower - centres) / sigma, (self.upper - centres) / sigma
        density = (np.exp(-(low**2) / 2) - np.exp(-(high**2) / 2)) / np.sqrt(2 * np.pi)
        mean: Matrix = sigma * (density + low * ndtr(low) + high * ndtr(-high))
        return mean + (centres - actions)

    def _centre(self, action: Vector) -> Vector:
        return np.zeros_like(action) if self.kind == "literal" else action


class Algorithm:
    """A learning rule. Register its class in the entry-point group `cosim.algorithms`.

    The loop constructs it with a controller whose `theta` it may set, calls `observe` once per
    sample, and solves for the policy anew after an `Update`. `strategy` is the exploration; `rng` a
    generator of its own, spawned from the run's seed and kept in checkpoints. A class that has all
    this need not inherit it.

    `Configuration` is the class of its hyperparameters. `asks_for` states what it needs of a plant:
    `operation`, one trajectory as it comes, or `simulator`, a plant that can be reset, put back and
    given the same noise twice. `needs_action_value` asks for `Transition.action_value` where the
    sample explored, `needs_points` for the linearisation points. `KEPT` names the attributes that a
    checkpoint has (`learning.checkpoint.arrays_of`).

    Optional, looked up by name:

    - `theta` (n_θ,), a property: the θ that the run would hand over now, where the controller
      carries another one. Log, evaluation, divergence, parameters.toml and summary are of it.
    - `budget`, int, of the class: samples of a run where the user says nothing, else 50 000.
    - `first_episode`, int (simulator only): seed of the plant's noise at the start.
    - `explores`, bool: whether the samples explore now; they do where it is not there.
    - `failed(cost) -> Update | None`: called in place of `observe` on a sample at which the
      controller failed, with the sample's share of J.
    """

    Configuration: ClassVar[type[Configuration]] = Configuration
    asks_for: ClassVar[Privilege] = "operation"
    KEPT: ClassVar[tuple[str, ...]] = ()
    needs_action_value = False
    needs_points = False

    def __init__(
        self,
        controller: RtiNmpc,
        scenario: Scenario,
        configuration: Any,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None:
        self.controller, self.scenario, self.configuration = controller, scenario, configuration
        self.samples, self.strategy, self.rng = samples, strategy, rng

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; move θ and say so, or return None."""
        return None

    def state(self) -> State:
        """State for a checkpoint, without θ."""
        return arrays_of(self)

    def restore(self, state: State) -> None:
        """Restore what `state` returned."""
        take_up(self, state)


def algorithms() -> list[str]:
    """Names of the algorithms that are registered."""
    return sorted(registered(ALGORITHMS))


def load_algorithm(name: str) -> type[Algorithm]:
    """Class of an algorithm by registered name or `module:Class`; raises AlgorithmLookupError."""
    known = registered(ALGORITHMS)
    if (target := known.get(name, name)) == name and ":" not in name:
        raise AlgorithmLookupError(
            f"unknown algorithm '{name}'{suggestion(name, known)}; registered are "
            f"{', '.join(sorted(known))}, or give module:Class"
        )
    found = load_plugin(target, f"algorithm '{name}'", AlgorithmLookupError)
    needed = ("Configuration", "asks_for", "observe", "state", "restore")
    if missing := [part for part in needed if not hasattr(found, part)]:
        raise AlgorithmLookupError(f"algorithm '{name}' lacks {', '.join(missing)}")
    if found.asks_for not in get_args(Privilege):
        raise AlgorithmLookupError(
            f"algorithm '{name}': asks_for must be operation or simulator, not {found.asks_for!r}"
        )
    algorithm: type[Algorithm] = found
    return algorithm


class PlantInOperation:
    """A plant that can only take its next sample: no reset, no snapshot, no choice of noise."""

    __slots__ = ("scenario", "step")
    step: Callable[[Vector], Step]

    def __init__(self, plant: Plant | PlantInOperation) -> None:
        self.scenario: Scenario = plant.scenario

        def step(a: Vector) -> Step:
            return plant.step(a)

        self.step = step


@dataclass
class Counts:
    """Counts since a loop's start.

    `number` of samples; `failures` of the controller; samples that `explored`, and of these those
    `saturated` at an actuator's bound; of every tenth sample, policies with one-sided derivatives
    (`weakly_active`) and with dependent active constraints (`licq_failed`).
    """

    KEPT: ClassVar = ("number", "failures", "explored", "saturated", "weakly_active", "licq_failed")
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

    `plant` has been reset; for an algorithm that asks for `operation` it is wrapped as a
    `PlantInOperation`. `rng` draws the exploration, `algorithm_rng` is the algorithm's own.
    """

    KEPT = ("s", "_applied", "counts", "algorithm")

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
        operates = algorithm.asks_for == "operation"
        self._simulator: Any = None if operates else plant
        self._plant = PlantInOperation(plant) if operates else plant
        self.controller, self.algorithm, self.rng = controller, algorithm, rng
        self._strategy = strategy
        self._generators = [rng] if algorithm_rng is None else [rng, algorithm_rng]
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
        """Whether exploration and learning have ended."""
        return self.counts.number >= self._rest_after

    def advance(self) -> tuple[float, Update | None]:
        """One sample of plant and rule: its cost, and the update if θ moved.

        Raises the rule's DivergenceError; PrivilegeError where it asks more of the plant than it
        stated.
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
            self._marked = (self.simulator("mark").snapshot(), self.s, self._point)
        if update.rewind:
            plant = self.simulator("rewind")
            if self._marked is None:
                raise PrivilegeError(f"{type(self.algorithm).__name__}: 'rewind' before any 'mark'")
            snapshot, self.s, self._point = self._marked
            plant.restore(snapshot)
            self.restart()
        elif update.episode is not None:
            self.start(self.simulator("episode").reset(update.episode))
        else:
            self.renew()
        return cost, update

    def renew(self) -> None:
        """Solve again for the present state at the same linearisation point, after θ has moved."""
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

    def simulator(self, privilege: str) -> Any:
        """The plant as a simulator, for a privilege; raises PrivilegeError if not asked for."""
        if self._simulator is None:
            raise PrivilegeError(
                f"{type(self.algorithm).__name__} asks for a plant in operation, and says "
                f"'{privilege}', which only a simulator can; state asks_for = \"simulator\""
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
        """Reset the controller but for its linearisation point.

        Done at each checkpoint and on resuming, so that both runs have the same digits.
        """
        self.controller.reset()
        if self._point is None:
            self._policy = self._solve(self.s, prepare=True)
        else:
            self.renew()

    def state(self) -> State:
        """State for `restore`, without the plant's."""
        state = arrays_of(self) | {"theta": self.controller.theta, "point": self._point}
        state["generators"] = [rng.bit_generator.state for rng in self._generators]
        if self._marked is not None:
            snapshot, s, point = self._marked
            content = np.frombuffer(self.simulator("mark").serialise(snapshot), np.uint8)
            state["marked"] = content, s, point
        return state

    def restore(self, state: State) -> None:
        """Restore what `state` returned; the plant must have been restored before."""
        self.controller.theta = state["theta"]
        take_up(self, state)
        # Only now: a rule may draw again what it drew before.
        for rng, drawn in zip(self._generators, state["generators"], strict=True):
            rng.bit_generator.state = drawn
        self._marked = None
        if "marked" in state:
            content, s, point = state["marked"]
            snapshot = self.simulator("mark").deserialise(content.tobytes())
            self._marked = snapshot, s, point and LinearisationPoint(*point)
        self._point = state["point"] and LinearisationPoint(*state["point"])
        self.restart()
