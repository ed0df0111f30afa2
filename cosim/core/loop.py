"""The closed loop of a plant and a controller, sample by sample, and its rule of a failed solve.

Every closed loop in Python is this one: a simulation, a training, a rollout on an empirical model,
the search of a back-off on the controller's own model. Its counterpart in C is
`controllers/export/sources/loop.h`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from cosim.core.errors import CosimError
from cosim.core.protocols import ActionLimits, Array, Controller, Solution, Step


class Sample(NamedTuple):
    """One sample of a closed loop.

    Attributes:
        s: state x_k, (n,).
        y: what the sensors showed at sample k, (n_y,); None without sensors.
        estimate: the controller's of x_k, (n,); None where it makes none.
        solution: the controller's; None after a failed solve.
        a: applied action u_k, (m,).
        step: what the plant gave, x_{k+1} included.
        prepare_time, feedback_time, plant_time: seconds of the three phases.
    """

    s: Array
    y: Array | None
    estimate: Array | None
    solution: Solution | None
    a: Array
    step: Step
    prepare_time: float
    feedback_time: float
    plant_time: float


class ClosedLoop:
    """A plant and a controller in closed loop.

    A sample is `prepare`, then `feedback(s)`, then the plant steps under the action, saturated to
    the actuators' bounds. Where the plant has sensors the controller is given y in place of s.
    Where the scenario has signals it is told before `prepare` what is known of them then. A
    failed solve is an exception whose class has `is_solver_failure`: the last applied action (first
    the reference action) is then applied once more, and the controller is reset. Every other error
    is raised.

    Args:
        step: the plant, from an action (m,) to what its next sample gave.
        controller: the feedback law.
        limits: bounds of the actuators, and the action of the first fallback.
        keeps_points: whether `point` is read from the controller.
        known: what is known of the scenario's signals at a sample, by its number
            (`cosim.core.signals`); None without signals.

    Attributes:
        lower, upper: bounds of the actuators, (m,).
        s: present state, (n,).
        y: what the sensors show at the present sample, (n_y,); None without sensors.
        number: of samples since the start.
        applied: action of the last sample, (m,); before the first, the reference action.
        solution: for the present state, once it is solved for; None after a failed solve.
        point: where the controller's QP was linearised for `solution`; None after a failed solve.
    """

    def __init__(
        self,
        step: Callable[[Array], Step],
        controller: Controller,
        limits: ActionLimits,
        *,
        keeps_points: bool = False,
        known: Callable[[int], Mapping[str, Array]] | None = None,
    ) -> None:
        self._step = step
        self._controller = controller
        self._limits = limits
        self.lower = limits.action_lower
        self.upper = limits.action_upper
        self._keeps_points = keeps_points
        # Optional methods of a controller that is given measurements (`Controller`).
        self._report_action = getattr(controller, "applied", None)
        self._resume = getattr(controller, "resume", controller.reset)
        self._given = getattr(controller, "given", "state")
        self._inform = getattr(controller, "inform", None)
        self._known = known
        self.s: Array = np.empty(0)
        self.y: Array | None = None
        self.number = 0
        self.applied = limits.reference_action
        self.solution: Any = None
        self.point: Any = None
        self._prepare_time = 0.0
        self._feedback_time = 0.0

    def start(self, s: Array, y: Array | None = None) -> None:
        """Begin an episode.

        Args:
            s: state to which the plant has been reset, (n,).
            y: what its sensors show there, (n_y,); None without sensors.

        Raises:
            CosimError: the plant has sensors, and the controller is made for exact states.
        """
        if y is not None and self._given == "state":
            raise CosimError(
                f"the scenario has sensors, and {controller_name(self._controller)} takes the "
                "exact state: put an estimator before it, "
                "controllers.OutputFeedback.from_scenario(scenario, controller)"
            )
        # As in `step`: whoever is given the state may keep it.
        s.flags.writeable = False
        self.s = s
        self.y = y
        self.number = 0
        self.applied = self._limits.reference_action
        self._controller.reset()

    def advance(self) -> Sample:
        """Solve for the present state, and let the plant take a sample under the action."""
        self.solve()
        return self.step(self.action())

    @property
    def given(self) -> Array:
        """What the controller is given at the present sample: y (n_y,) or the state (n,)."""
        if self.y is None or self._given == "truth":
            return self.s
        return self.y

    def inform(self) -> None:
        """Tell the controller what is known of the scenario's signals at the present sample."""
        if self._known is not None and self._inform is not None:
            self._inform(self._known(self.number))

    def solve(self, *, prepare: bool = True) -> bool:
        """Prepare, and feed the present state back, into `solution`.

        Args:
            prepare: whether to prepare; else the controller's own preparation is used.

        Returns:
            Whether there is a solution.

        Raises:
            CosimError: the controller gave what is no solution.
        """
        begin = middle = perf_counter()
        # The two phases are timed apart: only feedback delays the action.
        try:
            if prepare:
                self.inform()
                self._controller.prepare()
                # Now: a feedback of several QPs linearises elsewhere.
                if self._keeps_points:
                    self.point = self._controller.linearisation_point  # type: ignore[attr-defined]
                middle = perf_counter()
            self.solution = self._controller.feedback(self.given)
            end = perf_counter()
            self._check_solution()
        except Exception as error:
            end = perf_counter()
            self._recover(error)
        self._prepare_time = middle - begin
        self._feedback_time = end - middle
        return self.solution is not None

    def solve_for(self, a: Array) -> Any:
        """Solution for Q(s, a) with the preparation of `solve`; None after a failed solve.

        Args:
            a: action that is enforced, (m,).
        """
        try:
            return self._controller.feedback(self.given, a)
        except Exception as error:
            self._recover(error)
            return None

    def action(self) -> Array:
        """The action of the present sample, (m,): the solution's, or the last one once more."""
        if self.solution is None:
            return self.applied
        action = self.solution.action
        # NumPy would spread a number over all inputs, and take truth for one.
        if not isinstance(action, np.ndarray) or action.dtype.kind not in "fiu":
            description = f"{type(action).__name__} {action}"
        elif action.shape != self.lower.shape:
            description = f"shape {action.shape}"
        else:
            return self.saturate(action)
        raise self.wrong(f"an action of {description}, not {self.lower.shape}", number=self.number)

    def saturate(self, action: Array) -> Array:
        """An action (m,) within the actuators' bounds: the QP keeps them to its tolerance only."""
        return np.minimum(np.maximum(action, self.lower), self.upper)

    def step(self, a: Array) -> Sample:
        """Let the plant take a sample.

        Args:
            a: action within the actuators' bounds, (m,).

        Returns:
            The sample; a later change of its states or action is an error.

        Raises:
            PlantError: by the plant; the loop is still before the sample.
        """
        begin = perf_counter()
        step = self._step(a)
        plant_time = perf_counter() - begin
        estimate = None
        # Of an exact state nothing has to be estimated.
        if self.y is not None:
            estimate = getattr(self._controller, "estimate", None)
        sample = Sample(
            self.s,
            self.y,
            estimate,
            self.solution,
            a,
            step,
            self._prepare_time,
            self._feedback_time,
            plant_time,
        )
        # Controllers and rules read these arrays, and may keep them.
        a.flags.writeable = False
        step.s.flags.writeable = False
        self.s = step.s
        self.y = step.y
        self.applied = a
        if self._report_action is not None:
            self._report_action(a)
        self.number += 1
        return sample

    def wrong(self, answer: str, number: int | None = None) -> CosimError:
        """An error that names the controller.

        Args:
            answer: what the controller gave, in words.
            number: of the sample; None where it does not matter.
        """
        where = "" if number is None else f", at step {number}"
        return CosimError(f"{controller_name(self._controller)} gave {answer}{where}")

    def _check_solution(self) -> None:
        """Raise CosimError where a foreign controller's solution lacks an action or a status."""
        solution = self.solution
        if not hasattr(solution, "action"):
            raise self.wrong(f"a {type(solution).__name__}, which is no solution")
        status = getattr(solution, "status", None)
        if not isinstance(status, str):
            raise self.wrong(f"a status that is no text but {status!r:.60}")

    def _recover(self, error: Exception) -> None:
        """The rule of a failed solve; raises every other error."""
        if not getattr(type(error), "is_solver_failure", False):
            raise error
        # What led to the failure is forgotten: the next sample is solved from the reference.
        self._resume()
        self.solution = None
        self.point = None


def controller_name(controller: Any) -> str:
    """Name of a controller for tables: its `name`, else its class's."""
    return str(getattr(controller, "name", type(controller).__name__))
