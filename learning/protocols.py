"""What the training loop asks of a learnable controller and of an algorithm."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from controllers.rti.prepared import LinearisationPoint
from cosim.protocols import Controller, Solution, Step
from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.exploration import Strategy

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class LearnableSolution(Solution, Protocol):
    """V or Q with its sensitivities to θ; `controllers.rti.RtiSolution` is one."""

    @property
    def value_gradient(self) -> Vector:
        """dV/dθ or dQ/dθ, (n_θ,)."""

    @property
    def policy_jacobian(self) -> Matrix:
        """dπ/dθ, (m, n_θ)."""

    @property
    def weakly_active(self) -> bool:
        """Whether a constraint is about to change its activity: derivatives are one-sided."""

    @property
    def licq(self) -> bool:
        """Whether the active constraints' gradients are linearly independent."""


class LearnableController(Controller, Protocol):
    """A controller with parameters θ; `RtiNmpc` and `ConvergedNmpc` are.

    `memoryless` says that a feedback depends, to the tolerance of its solver, on nothing but θ, the
    point at which it was prepared, s and a; so what was solved for once need not be again.
    """

    theta: Vector
    memoryless: bool

    @property
    def parameters(self) -> Parameters:
        """θ with its blocks."""

    @property
    def linearisation_point(self) -> LinearisationPoint:
        """Where the QP was linearised, copies."""

    def prepare_at(self, point: LinearisationPoint) -> None:
        """Linearise at a point, at the present θ."""

    def feedback(self, s: Vector, a: Vector | None = None) -> LearnableSolution:
        """Solve for V and π, or with the first action fixed for Q."""


class ContinuablePlant(Protocol):
    """A plant whose state goes through a checkpoint; `FmuPlant` is one."""

    @property
    def scenario(self) -> Scenario:
        """The scenario that the plant realises."""

    def reset(self, seed: int) -> Vector:
        """Start an episode."""

    def step(self, a: Vector) -> Step:
        """Hold an action for one sample."""

    def snapshot(self) -> Any:
        """The plant as it is, its noise to come included."""

    def restore(self, snapshot: Any) -> Any:
        """Put a snapshot back."""

    def serialise(self, snapshot: Any) -> bytes:
        """A snapshot as bytes."""

    def deserialise(self, content: bytes) -> Any:
        """The snapshot of these bytes."""


class Transition(NamedTuple):
    """One transition (s, a, ℓ, s₊) as the training loop saw it, all at one θ.

    `policy` is the solution for V(s) and π(s); `action_value` that for Q(s, a), the same object
    where the sample was greedy (then Q = V) or the algorithm does not need it; `next_policy` that
    for V(s₊), π(s₊); `next_s` is s₊; `explored` says that a is not π(s). `stage_cost` is ℓ, `cost`
    ℓ plus the penalty of s, the sample's share of J; `next_penalty` the penalty of s₊. `point` and
    `next_point` are the linearisation points at s and s₊, None unless the algorithm
    `needs_points`. `number` counts from 0.
    """

    number: int
    s: Vector
    a: Vector
    explored: bool
    policy: LearnableSolution
    action_value: LearnableSolution
    stage_cost: float
    cost: float
    next_s: Vector
    next_penalty: float
    next_policy: LearnableSolution
    point: LinearisationPoint | None
    next_point: LinearisationPoint | None


class Update(NamedTuple):
    """What an algorithm says of an update of θ, for the log.

    `td_error` is the root mean square TD error that the update saw, `step` the norm of the scaled
    step, `smallest_eigenvalue` the certificate's; `corrected` and `refused` are its flags;
    `failures` counts QPs of its own that failed. With `episode` the loop goes on with a new
    episode, from the scenario's initial state and with this seed of the plant's noise. `mark`
    remembers the plant as it is now, `rewind` puts it back to there, with the same noise to come.
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


class Rule(Protocol):
    """What learns from transitions: an algorithm, or what one has inside."""

    @property
    def needs_action_value(self) -> bool:
        """Whether `Transition.action_value` must be solved for where the sample explored."""

    @property
    def needs_points(self) -> bool:
        """Whether `Transition.point` and `Transition.next_point` must be kept."""

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; move θ and say so, or return None."""

    def state(self) -> dict[str, NDArray[Any]]:
        """All that must survive a checkpoint but θ."""

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""


class Algorithm(Rule, Protocol):
    """A learning rule. Register its class in the entry-point group `cosim.algorithms`.

    `Configuration` is the class of its hyperparameters. The loop constructs it with a controller
    that it may move (`controller.theta`), calls `observe` once per sample, and evaluates anew the
    policy whenever `observe` returned an Update. `rng` is a generator of its own, spawned from the
    run's seed. `state` and `restore` carry all else that it remembers, as arrays, through a
    checkpoint, the generator's state excepted, which the loop keeps.

    Optional, looked up by name:

    - `theta` (n_θ,), a property: the θ that the run would hand over now, where that is another one
      than it behaves with. Evaluation, log, parameters.toml and summary show it.
    - `budget`, int, of the class: samples of a run where the user says nothing, else 50 000.
    - `first_episode`, int: seed of the plant's noise in the first episode, in place of the run's.
    - `explores`, bool: whether the samples explore now; they do where it is not there.
    - `failed(cost) -> Update | None`: called in place of `observe` on a sample at which the
      controller failed, with the sample's share of J.
    - `validated(accepted, theta)`: called after each validation run, with whether the θ handed
      over is better than the incumbent and which θ is the incumbent now.
    """

    Configuration: ClassVar[type[Configuration]]

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: Any,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None: ...
