"""What a training asks of an algorithm; algorithms by name.

An own rule inherits `Algorithm`, is given a `Transition` and returns an `Update`.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from controllers.rti import LinearisationPoint, RtiNmpc, RtiSolution
from cosim.plugins import ALGORITHMS, load_plugin, registered
from cosim.protocols import Vector
from cosim.scenario import Scenario
from cosim.validation import suggestion
from learning.checkpoint import arrays_of, take_up
from learning.configuration import Configuration, Strategy
from learning.errors import AlgorithmLookupError

Privilege = Literal["operation", "simulator"]


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

    `td_error` is the root mean square TD error that the update saw, `step` the norm of the scaled
    step, `smallest_eigenvalue` that of B_l and B_Vf at the new θ; `corrected` and `refused` say
    that the step was changed to keep them definite, or not taken, as the best back-off that lies at
    the end of what was tried; `failures` counts QPs of the algorithm's own that failed.

    The last three are for algorithms that ask for a simulator; PrivilegeError otherwise. `episode`
    resets the plant to the scenario's initial state with this seed of its noise. `mark` remembers
    the plant as it is now, `rewind` puts it back to there, with the same noise to come.
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


class Algorithm:
    """A learning rule. Register its class in the entry-point group `cosim.algorithms`.

    The loop constructs it with a controller that it may move (`controller.theta`), calls `observe`
    once per sample, and evaluates the policy anew whenever that returned an `Update`. `strategy` is
    the exploration; `rng` is a generator of its own, spawned from the run's seed, whose state the
    loop keeps in checkpoints. A class that has all this need not inherit it.

    `Configuration` is the class of its hyperparameters. `asks_for` states what it needs of a plant:
    `operation`, one trajectory as it comes, or `simulator`, a plant that can be reset, put back and
    given the same noise twice. `needs_action_value` says whether `Transition.action_value` must be
    solved for where the sample explored, `needs_points` whether the linearisation points are kept.
    `KEPT` names the attributes that a checkpoint has (`learning.checkpoint.arrays_of`).

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

    def state(self) -> dict[str, NDArray[Any]]:
        """What a checkpoint must keep besides θ."""
        return arrays_of(self)

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
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
