"""The loop of plant, controller and learning rule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import inf, nan
from typing import Any

import numpy as np

from controllers.estimator import measured
from controllers.rti import LinearisationPoint, RtiNmpc, RtiSolution
from controllers.theta import Parameters
from cosim.core.protocols import Plant, Step, Vector
from cosim.core.scenario import Penalty, Scenario
from cosim.core.signals import Known, Signals
from cosim.core.simulation import ClosedLoop
from cosim.plant import FmuPlant
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, generator_state, part_of, prefixed, set_generator_state
from learning.errors import ConfigurationError, PrivilegeError
from learning.exploration import Strategy
from learning.gaussian_penalty import normal_penalties
from learning.retreat import Retreat
from learning.signal_costs import SignalCosts
from learning.step import update_without_fit

FLAGS_EVERY = 10
"""Samples between two checks of a solution's flags, which cost as much as a feedback."""


class PlantInOperation:
    """A plant that can only take its next sample: no reset, no snapshot, no choice of noise."""

    __slots__ = ("scenario", "step")
    step: Callable[[Vector], Step]

    def __init__(self, plant: Plant | PlantInOperation) -> None:
        self.scenario: Scenario = plant.scenario

        # A closure: no attribute of this object leads to the plant.
        def step(a: Vector) -> Step:
            return plant.step(a)

        self.step = step


@dataclass
class Counts:
    """Counts since a loop's start.

    Attributes:
        number: samples.
        failures: of the controller.
        explored: samples that explored.
        saturated: of these, samples at an actuator's bound.
        weakly_active: of every tenth sample, policies with one-sided derivatives.
        licq_failed: of every tenth sample, policies with dependent active constraints.
    """

    number: int = 0
    failures: int = 0
    explored: int = 0
    saturated: int = 0
    weakly_active: int = 0
    licq_failed: int = 0


class TrainingLoop:
    """Takes samples from a plant and lets a rule move the controller's θ.

    The loop is `cosim.core.simulation.ClosedLoop`; this one chooses its actions and counts its
    failures.
    V(s₊) of a sample is V(s) of the next one, so a greedy sample costs one QP.

    Args:
        plant: has been reset; a rule that requires `operation` gets it as a `PlantInOperation`.
        controller: carries θ.
        algorithm: the rule.
        strategy: the exploration.
        rng: draws the exploration.
        rest_after: samples after which θ stays and nothing explores; None: never.
        algorithm_rng: the rule's own generator, which checkpoints keep.
        retreat: says when θ goes back to a better one; None: never.
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
        retreat: Retreat | None = None,
    ) -> None:
        scenario = plant.scenario
        # A rule in operation cannot reach the plant, not even by an attribute.
        self._simulator: Any = None
        in_operation: FmuPlant | PlantInOperation = PlantInOperation(plant)
        if algorithm.requires == "simulator":
            self._simulator = plant
            in_operation = plant
        # What runs in the loop; `controller`, behind the estimator if there is one, carries θ.
        self.law = measured(scenario, controller)
        self.signals = Signals(scenario) if scenario.signals else None
        self._signal_costs = SignalCosts(controller.problem)
        # What known prices change of the present sample's cost, and of V.
        self._signal_changes = (0.0, 0.0)
        self._known: Known | None = None
        self._loop = ClosedLoop(
            in_operation.step,
            self.law,
            scenario,
            keeps_points=True,
            known=None if self.signals is None else self.signals.known,
        )
        self.controller = controller
        self.algorithm = algorithm
        self.rng = rng
        self._algorithm_rng = algorithm_rng
        self._strategy = strategy
        self._retreat = retreat
        self.start_parameters = controller.parameters
        self._rest_after = inf if rest_after is None else rest_after
        self._still_penalty = scenario.state_penalty
        self.counts = Counts()

    def start(self, s: Vector, y: Vector | None = None) -> None:
        """Begin an episode.

        Args:
            s: state to which the plant has been reset, (n,).
            y: what its sensors show there, (n_y,); None without sensors.
        """
        self._loop.start(s, y)
        self._solve()

    @property
    def s(self) -> Vector:
        """Present state, (n,)."""
        return self._loop.s

    @property
    def known_state(self) -> Vector:
        """Present state for a rule, (n,): under sensors the estimate."""
        if self._loop.y is None:
            return self._loop.s
        estimate: Vector = self.law.estimate  # type: ignore[attr-defined]
        return estimate

    @property
    def penalty(self) -> Penalty:
        """Penalty by the bounds of the present sample."""
        if self.signals is None:
            return self._still_penalty
        return self.signals.penalty(self._loop.number)

    @property
    def known_penalty(self) -> float:
        """Present penalty for a rule: under sensors its expectation."""
        s = self.known_state
        variances = self._estimate_variances
        if variances is None:
            return self.penalty(s.tolist())
        return float(normal_penalties(self.penalty, s[None], variances[None]).sum())

    @property
    def _estimate_variances(self) -> Vector | None:
        """Of the errors of the present estimate, (n,); None where the state is known."""
        estimator = getattr(self.law, "estimator", None)
        covariance = getattr(estimator, "covariance", None)
        if self._loop.y is None or covariance is None:
            return None
        variances: Vector = covariance.diagonal()
        return variances

    @property
    def parameters(self) -> Parameters:
        """The final θ so far: the rule's own where it reports one, else the controller's."""
        # A rule that tries θ has a candidate in the controller, and reports another one.
        theta = getattr(self.algorithm, "theta", None)
        present = self.controller.parameters
        if theta is None:
            return present
        return present.with_theta(theta)

    @property
    def has_ended(self) -> bool:
        """Whether exploration and learning have ended (`rest_after`)."""
        return self.counts.number >= self._rest_after

    def advance(self) -> tuple[float, Update | None]:
        """One sample of plant and rule.

        Returns:
            The sample's share of J, and the update if θ moved.

        Raises:
            DivergenceError: by the rule.
            PrivilegeError: the rule asks more of the plant than it `requires`.
            ConfigurationError: the rule's `observe` returns what is no update.
        """
        # Asked before the sample: the last one that may teach still does.
        has_ended = self.has_ended
        transition, cost = self.next()
        if has_ended:
            return cost, None
        update: Update | None = None
        if self._waits:
            # θ stays after a retreat; what happens then may still be remembered.
            if transition is not None and hasattr(self.algorithm, "watch"):
                self.algorithm.watch(transition)
        elif transition is not None:
            update = self.algorithm.observe(transition)
            if update is not None and not isinstance(update, Update):
                got = type(update).__name__
                raise ConfigurationError(f"observe must return None or Update, got {got}")
        elif hasattr(self.algorithm, "failed"):
            update = self.algorithm.failed(cost)
        if update is not None and update.lost and self._retreat is not None:
            self._go_back(self._retreat.best_theta)
        # J is of the truth; what is compared is what can be known of it.
        known_cost = cost if transition is None else transition.known_cost
        update = self._compared(known_cost) or update
        if update is None:
            return cost, None
        self.counts.failures += update.failures
        # A new episode begins; else θ has moved under the present state.
        if update.episode is not None:
            simulator = self.simulator("episode")
            self.start(simulator.reset(update.episode), simulator.y)
        else:
            self.renew()
        return cost, update

    @property
    def _waits(self) -> bool:
        """Whether θ stays as it is, after a retreat."""
        return self._retreat is not None and self._retreat.samples_to_wait > 0

    def _compared(self, cost: float) -> Update | None:
        """Compare the cost of the shift that a sample may end; the update of a retreat."""
        if self._retreat is None:
            return None
        theta = self.controller.theta
        predicted = getattr(self.algorithm, "predicted_cost", nan)
        back = self._retreat.observe(cost, theta, predicted)
        if back is None:
            return None
        self._go_back(back)
        blocks = self.controller.parameters.blocks
        update = update_without_fit(blocks, theta, back)
        return update._replace(retreated=True)

    def _go_back(self, theta: Vector) -> None:
        """Set θ back and tell the rule."""
        if np.array_equal(theta, self.controller.theta):
            return
        self.controller.theta = theta
        if hasattr(self.algorithm, "retreat"):
            self.algorithm.retreat()

    def renew(self) -> None:
        """Solve again for the present state at the same linearisation point, after θ has moved."""
        point = self._loop.point
        if point is not None:
            # Where the new θ has no finite QP there, that is a failed solve.
            self._solve(lambda: self.controller.prepare_at(point))

    def next(self) -> tuple[Transition | None, float]:
        """One sample of the plant.

        Returns:
            Its transition, None after a failure, and its share of J.
        """
        loop = self._loop
        solution: RtiSolution | None = loop.solution
        point: LinearisationPoint | None = loop.point
        number = self.counts.number
        s = self.known_state
        # Of the present estimate, which the next sample replaces.
        rule_penalty = known_penalty = 0.0
        if loop.y is not None:
            rule_penalty = self.penalty(s.tolist())
            known_penalty = self.known_penalty
        a, explored = self._choose(solution)
        # V and Q are one where a = π(s): a greedy sample costs one QP.
        q_solution = solution
        if explored and self.algorithm.needs_q_solution:
            q_solution = loop.solve_for(a)
            self.counts.failures += q_solution is None
        if solution is not None and number % FLAGS_EVERY == 0:
            self.counts.weakly_active += solution.weakly_active
            self.counts.licq_failed += not solution.licq
        sample = loop.step(a)
        self.counts.number = number + 1
        stage_change, value_change = self._signal_changes
        known = self._known
        # The solution at s₊ serves the next sample too.
        self._solve()
        next_solution: RtiSolution | None = loop.solution
        next_value_change = self._signal_changes[1]
        step = sample.step
        if self.signals is not None:
            self.signals.check_foreseen(step.disturbance[None], number)
        cost = step.stage_cost + step.penalty
        if solution is None or q_solution is None or next_solution is None:
            return None, cost
        # J is of the truth; a rule is told what can be known of it. Q and V take the estimate for
        # the state: the cost that goes with them does, too.
        next_s = self.known_state
        known_cost = rule_cost = cost
        if sample.y is not None:
            known_cost = step.stage_cost + known_penalty
            rule_cost = step.stage_cost + rule_penalty
        needs_points = self.algorithm.needs_points
        transition = Transition(
            number=number,
            s=s,
            a=a,
            explored=explored,
            solution=solution,
            q_solution=q_solution,
            stage_cost=step.stage_cost,
            cost=rule_cost,
            known_cost=known_cost,
            next_s=next_s,
            next_penalty=self.penalty(next_s.tolist()),
            next_solution=next_solution,
            point=point if needs_points else None,
            next_point=loop.point if needs_points else None,
            y=sample.y,
            moved_penalty=self._moved_penalty(),
            signal_cost=stage_change + next_value_change - value_change,
            known=known,
            next_variances=self._estimate_variances,
        )
        return transition, cost

    def _moved_penalty(self) -> Penalty | None:
        """The present penalty where signals move the bounds; None else."""
        if self.signals is None or not self.signals.move_bounds:
            return None
        return self.penalty

    def _choose(self, solution: RtiSolution | None) -> tuple[Vector, bool]:
        """The action to apply, (m,), within the actuators' bounds, and whether it explores."""
        loop = self._loop
        explores = not self.has_ended and getattr(self.algorithm, "explores", True)
        # After a failed solve there is no action to explore about.
        if solution is None or not explores:
            return loop.action(), False
        wanted = self._strategy(solution.action, self.rng, self.counts.number)
        if wanted is None:
            return loop.action(), False
        a = loop.saturate(wanted)
        self.counts.explored += 1
        at_lower = a == loop.lower
        at_upper = a == loop.upper
        at_bound = at_lower | at_upper
        self.counts.saturated += bool(at_bound.any())
        return a, True

    def simulator(self, privilege: str) -> Any:
        """The plant as a simulator, for a privilege; raises PrivilegeError if not required."""
        if self._simulator is None:
            raise PrivilegeError(
                f"{type(self.algorithm).__name__} requires a plant in operation, and says "
                f"'{privilege}', which only a simulator can; state requires = \"simulator\""
            )
        return self._simulator

    def _solve(self, prepare: Callable[[], None] | None = None) -> None:
        """Solve for V(s) and π(s) of the present state; a failure is counted.

        Args:
            prepare: as in `ClosedLoop.solve`.
        """
        if self.signals is not None:
            self._known = self.signals.known(self._loop.number)
            self._signal_changes = self._signal_costs.of_sample(self._known)
        self.counts.failures += not self._loop.solve(prepare)

    def restart(self) -> None:
        """Reset the controller but for its linearisation point.

        Done at each checkpoint and on resuming, so that both runs have the same digits.
        """
        self.controller.reset()
        self._loop.inform()
        # A failed sample has left no linearisation point.
        if self._loop.point is None:
            # Not by the law, whose estimator has predicted this sample already.
            self._solve(self.controller.prepare)
        else:
            self.renew()

    def state_dict(self) -> State:
        """Arrays and numbers of loop and rule, θ included, without the plant's."""
        state: State = {
            "theta": self.controller.theta,
            "s": self._loop.s,
            "applied": self._loop.applied,
            "rng": generator_state(self.rng),
        }
        if self._algorithm_rng is not None:
            state["algorithm_rng"] = generator_state(self._algorithm_rng)
        if self._loop.point is not None:
            state |= prefixed("point", self._loop.point._asdict())
        if self._loop.y is not None:
            state["y"] = self._loop.y
            law: Any = self.law
            state |= prefixed("estimator", law.state_dict())
        state |= prefixed("counts", asdict(self.counts))
        if self._retreat is not None:
            state |= prefixed("retreat", self._retreat.state_dict())
        state |= prefixed("algorithm", self.algorithm.state_dict())
        return state

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; the plant must have been restored before."""
        self.controller.theta = state["theta"]
        self._loop.s = state["s"]
        self._loop.applied = state["applied"]
        point = part_of(state, "point")
        self._loop.point = LinearisationPoint(**point) if point else None
        if "y" in state:
            self._loop.y = state["y"]
            law: Any = self.law
            law.load_state_dict(part_of(state, "estimator"))
        self.counts = Counts(**part_of(state, "counts"))
        # Signals are those of a sample's number.
        self._loop.number = self.counts.number
        if self._retreat is not None:
            self._retreat.load_state_dict(part_of(state, "retreat"))
        self.algorithm.load_state_dict(part_of(state, "algorithm"))
        # Only now: a rule may draw while it restores itself.
        set_generator_state(self.rng, state["rng"])
        if self._algorithm_rng is not None:
            set_generator_state(self._algorithm_rng, state["algorithm_rng"])
        self.restart()
