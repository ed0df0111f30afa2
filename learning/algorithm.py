"""Interface of a learning rule: a `Transition` in, an `Update` out, and the base class.

The loop of plant, controller and rule is `learning.loop`.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np

from controllers.rti import LinearisationPoint, RtiNmpc, RtiSolution
from cosim.core.modules import ALGORITHMS, load_plugin, registered, target_in_file
from cosim.core.protocols import Vector
from cosim.core.scenario import Penalty, Scenario
from cosim.core.signals import Known
from cosim.core.validation import suggestion
from learning.checkpoint import State
from learning.configuration import Configuration
from learning.errors import AlgorithmLookupError
from learning.exploration import Strategy

Privilege = Literal["operation", "simulator"]


class Transition(NamedTuple):
    """One transition (s, a, ℓ, s₊), all at one θ.

    Attributes:
        number: of the sample, from 0.
        s: state, (n,).
        a: applied action, (m,).
        explored: whether a is not π(s).
        solution: for V(s) and π(s).
        q_solution: for Q(s, a); the same object as `solution` where the sample was greedy (then
            Q = V) or the algorithm does not need it.
        stage_cost: ℓ.
        cost: ℓ plus the penalty of s, as in Q(s, a).
        known_cost: what can be known of the sample's share of J: `cost`; under sensors ℓ plus the
            expected penalty of the state.
        next_s: s₊, (n,).
        next_penalty: penalty of s₊, as in V(s₊).
        next_solution: for V(s₊) and π(s₊).
        point, next_point: linearisation points at s and s₊, None unless the rule `needs_points`.
        y: what the sensors showed at s, (n_y,), NaN where nothing came; None without sensors.
        moved_penalty: penalty of the bounds as they are at s₊; None where no signal moves them.
        signal_cost: what known prices alone change of ℓ + V(s₊) − Q(s, a), at the reference.
        known: what was known of the signals at s, by their names; None without signals.
        next_variances: of the errors of the estimate s₊, (n,); None where the state is known.
    """

    number: int
    s: Vector
    a: Vector
    explored: bool
    solution: RtiSolution
    q_solution: RtiSolution
    stage_cost: float
    cost: float
    known_cost: float
    next_s: Vector
    next_penalty: float
    next_solution: RtiSolution
    point: LinearisationPoint | None
    next_point: LinearisationPoint | None
    y: Vector | None = None
    moved_penalty: Penalty | None = None
    signal_cost: float = 0.0
    known: Known | None = None
    next_variances: Vector | None = None


class Update(NamedTuple):
    """An update of θ: what the log says of it, and a request to the plant.

    Attributes:
        td_error: root mean square TD error of the update's samples; NaN of a rule without.
        step: norm of the scaled step.
        smallest_eigenvalue: of B_l and B_Vf at the new θ.
        corrected: the step was changed to keep them definite.
        refused: the step was not taken, or the best back-off was the last one tried.
        failures: the algorithm's own QPs that failed.
        lost: the rule knows nothing of what any θ costs; the loop sets the best one shown, the
            start at first.
        retreated: θ went back to one that has been shown to cost less (`learning.retreat`).
        episode: seed of the plant's noise with which to reset the plant to the scenario's initial
            state, for algorithms that require a simulator; PrivilegeError otherwise.
    """

    td_error: float
    step: float
    smallest_eigenvalue: float
    corrected: bool = False
    refused: bool = False
    failures: int = 0
    episode: int | None = None
    lost: bool = False
    retreated: bool = False


class Algorithm:
    """A learning rule. Register its class in the entry-point group `cosim.algorithms`.

    The loop constructs it with a controller whose `theta` it may set, and calls `observe` once per
    sample. After an `Update` the loop solves for the policy again. A class that has all this need
    not inherit it.

    Attributes of the class:

    - `Configuration`: the class of its hyperparameters.
    - `requires`: `operation`, one trajectory as it comes, or `simulator`, a plant that can be
      reset.
    - `needs_q_solution`: whether it reads `Transition.q_solution` where the sample explored.
    - `needs_points`: whether it reads the linearisation points.
    - `learns_from_estimates`: whether it may run where the scenario has sensors. `s` and
      `next_s` of a transition are then estimates, its penalties expectations.
    - `learns_under_signals`: whether it may run where the scenario has signals. Solutions are then
      those of the signals as they are known at their samples. A rule that solves a past sample
      again must not: the controller knows the present signals alone.

    Optional, looked up by name:

    - `under_sensors`, of the class: the rule that takes its place where the scenario has sensors,
      with the same `Configuration`.
    - `theta` (n_θ,), a property: the final θ so far, where the controller carries another one.
      Log, evaluation, divergence, parameters.toml and summary are of it. Such a rule tries θ on
      purpose, so it never retreats.
    - `budget`, int, of the class: samples of a run where the user says nothing, else 50 000.
    - `first_episode`, int (simulator only): seed of the plant's noise at the start.
    - `explores`, bool: whether the samples explore now; they do where it is not there.
    - `retreat()`: called where the loop has set θ back; the rule goes on from that.
    - `watch(transition)`: called in place of `observe` while θ stays after a retreat.
    - `predicted_cost`, float: what θ is expected to cost on average, NaN where that is unknown.
    - `changes`, int: how often the rule has detected that the plant is another one.
    - `failed(cost) -> Update | None`: called in place of `observe` on a sample at which the
      controller failed, with the sample's share of J.

    Args:
        controller: what carries θ.
        scenario: the plant, its bounds and costs.
        configuration: the hyperparameters.
        samples: samples of the run.
        strategy: the exploration.
        rng: a generator of its own, spawned from the run's seed; checkpoints keep its state.
    """

    Configuration: ClassVar[type[Configuration]] = Configuration
    requires: ClassVar[Privilege] = "operation"
    needs_q_solution = False
    needs_points = False
    learns_from_estimates = False
    learns_under_signals = False

    def __init__(
        self,
        controller: RtiNmpc,
        scenario: Scenario,
        configuration: Any,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None:
        self.controller = controller
        self.scenario = scenario
        self.configuration = configuration
        self.samples = samples
        self.strategy = strategy
        self.rng = rng

    def observe(self, transition: Transition) -> Update | None:
        """Learn from one sample; move θ and say so, or return None."""
        return None

    def state_dict(self) -> State:
        """Arrays and numbers that, with θ, are all that the rule remembers.

        Names of a part begin with the part's and a dot (`learning.checkpoint.prefixed`).
        """
        return {}

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; the controller has its θ already."""


def algorithms() -> list[str]:
    """Names of the algorithms that are registered."""
    return sorted(registered(ALGORITHMS))


def load_algorithm(name: str) -> type[Algorithm]:
    """Class of an algorithm by registered name or `module:Class`; raises AlgorithmLookupError."""
    known = registered(ALGORITHMS)
    if name.endswith(".py") and ":" not in name:
        raise AlgorithmLookupError(
            f"algorithm '{name}' is a file: give its class, {target_in_file(name)}, in the folder "
            "of the file"
        )
    if name not in known and ":" not in name:
        raise AlgorithmLookupError(
            f"unknown algorithm '{name}'{suggestion(name, known)}; registered are "
            f"{', '.join(sorted(known))}, or give module:Class"
        )
    # A name of the entry points, or module:Class itself.
    target = known.get(name, name)
    algorithm: type[Algorithm] = load_plugin(target, f"algorithm '{name}'", AlgorithmLookupError)
    # A class need not inherit `Algorithm`, so say here what it lacks.
    missing = []
    for part in ("Configuration", "requires", "observe", "state_dict", "load_state_dict"):
        if not hasattr(algorithm, part):
            missing.append(part)
    if missing:
        raise AlgorithmLookupError(f"algorithm '{name}' lacks {', '.join(missing)}")
    if algorithm.requires not in get_args(Privilege):
        raise AlgorithmLookupError(
            f"algorithm '{name}': requires must be operation or simulator, not "
            f"{algorithm.requires!r}"
        )
    return algorithm
