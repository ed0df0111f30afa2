"""Protocols of the closed loop: a plant, a controller and a recorder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from cosim.core.scenario import Scenario

Array = NDArray[np.float64]
Vector = Array
Matrix = Array


class Step(NamedTuple):
    """One sample of the plant: from x_k under u_k and d_k to x_{k+1}.

    The cost per sample that J averages is `stage_cost + penalty`.

    Attributes:
        s: x_{k+1}, (n,).
        stage_cost: ℓ(x_k, u_k, d_k), without penalty.
        penalty: that of x_k at the scenario's true bounds.
        disturbance: d_k, (p,).
        y: what the scenario's sensors show at sample k+1, (n_y,), NaN where nothing new came; None
            without sensors, where each state is known exactly at each sample.
    """

    s: Array
    stage_cost: float
    penalty: float
    disturbance: Array
    y: Array | None = None


class Plant(Protocol):
    """A sampled plant; `reset` starts an episode at k = 0, `step` advances by one sample."""

    @property
    def scenario(self) -> Scenario:
        """The scenario that the plant realises."""

    @property
    def units(self) -> dict[str, str]:
        """Unit of each state, action, disturbance and of the stage cost, by variable name."""

    def reset(self, seed: int) -> Array:
        """Start again from the scenario's initial state and return it, (n,)."""

    def step(self, a: Array) -> Step:
        """Hold the action a (m,) for one sampling time."""


class ActionLimits(Protocol):
    """Limits of the actuators, as a scenario and a controller's problem have them."""

    @property
    def action_lower(self) -> Array:
        """Lower bounds of the actions, (m,)."""

    @property
    def action_upper(self) -> Array:
        """Upper bounds of the actions, (m,)."""

    @property
    def reference_action(self) -> Array:
        """The action of the reference steady state, (m,)."""


class Solution(Protocol):
    """The result of a controller's `feedback`."""

    @property
    def action(self) -> Array:
        """Action, (m,)."""

    @property
    def value(self) -> float:
        """V(s), or Q(s, a) when an action was enforced; NaN if the controller has none."""

    @property
    def status(self) -> str:
        """`solved`, or the reason why not."""

    @property
    def residual(self) -> float:
        """Largest KKT residual of the problem solved; NaN if the controller has none."""

    @property
    def predicted_states(self) -> Array | None:
        """Predicted states, (N+1, n), or None."""

    @property
    def predicted_actions(self) -> Array | None:
        """Predicted actions, (N, m), or None."""


class Decision(NamedTuple):
    """Solution with an action (m,); every other field is optional."""

    action: Array
    value: float = nan
    status: str = "solved"
    residual: float = nan
    predicted_states: Array | None = None
    predicted_actions: Array | None = None


@runtime_checkable
class Controller(Protocol):
    """A feedback law in two phases: `prepare` before the state is known, `feedback` after.

    Optional attributes that are used when present: `name` (str), `parameters` (with `.hash`),
    `functions`, which says how its functions are computed, and those of a controller for a scenario
    with sensors:

    - `given`: what `feedback` takes, `"state"` (if it says nothing), `"measurement"` (y, with NaN
      where nothing new came), or `"truth"` (the state, which only a yardstick may see);
    - `applied(a)`: is called with each action that was applied, saturated and explored;
    - `resume()`: is called in place of `reset` after a failed solve, to keep the estimate;
    - `estimate`: of the state, (n,), for records.

    And for a scenario with signals:

    - `inform(known)`: is called before `prepare` with what is known of the signals at the sample,
      by their names: the present value and, of a preview, the coming ones, (1 + ahead,).

    An exception whose class has `is_solver_failure = True` makes the loop apply its fallback.
    """

    def reset(self) -> None:
        """Forget every earlier sample."""

    def prepare(self) -> None:
        """Do the work that needs no measurement, e.g. shift and linearise."""

    def feedback(self, s: Array, a: Array | None = None) -> Solution:
        """Solve for the measured state.

        Args:
            s: state, (n,).
            a: to which the first action is fixed, (m,); without it the controller chooses.
        """


CompiledLoop = Callable[[Any, int, Array], tuple[int, int, int]]
"""A closed loop in compiled code, from a controller's `compiled_loop` to a plant's `drive`.

It gets an FMU instance's native functions, the number of the first sample, and a table with a row
for each sample to come: state, action, stage cost, disturbance, value, residual, the controller's
status (by its number in `cosim.core.simulation.LOOP_STATUSES`), seconds of prepare, feedback and
step. It returns the sample that it came to, what failed there (0: nothing), and FMI's status.
"""


class Recorder(Protocol):
    """Takes a run part by part; the loop calls start, record…, close in this order."""

    def start(
        self,
        scenario: Scenario,
        controller: Controller,
        seed: int,
        steps: int,
        units: dict[str, str],
    ) -> None:
        """Open the record.

        Args:
            scenario: of the run.
            controller: that runs.
            seed: of the run.
            steps: number of its samples.
            units: of the FMU's variables, by name.
        """

    def record(
        self,
        first: int,
        columns: Mapping[str, Array],
        status: Sequence[str],
    ) -> None:
        """Append K samples; the loop overwrites the arrays later.

        Args:
            first: number of the first of them.
            columns: values by the names of `trajectory.SIGNALS`, (K,) or for a vector (K, n);
                `predicted_states` (K, N+1, n) and `predicted_actions` (K, N, m), NaN where the
                controller gave none, are there unless it never did.
            status: a word for each sample.
        """

    def close(self) -> None:
        """Finish the record; also called when the run fails."""
