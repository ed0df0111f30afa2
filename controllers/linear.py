"""Two baselines of a control course: a linear state feedback, and PI loops.

Both hold the reference steady state and know the nominal model alone. Neither keeps a distance from
a bound: that is asked for by the scenario's `reference_state`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from controllers.economic import local_feedback, tune
from controllers.errors import ControllerError
from controllers.problem import Problem, linear_model
from cosim.core.protocols import Array, Decision


class Lqr:
    """u = u_s − K (x − x_s), clipped to the action bounds.

    `gain` K (m, n) is that of the linear-quadratic problem whose weights are the convexified
    Hessian of `controllers.economic.tune`, γ = 1, without bounds. Raises TuningError.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        H = tune(problem).convexification.hessian
        A, B = linear_model(problem)
        # In the convexified Hessian the active bounds are a cost.
        no_constraints = np.zeros((0, len(H)))
        gain, _ = local_feedback(A, B, H, no_constraints)
        self.gain = -gain

    def reset(self) -> None:
        """Do nothing: the law has no memory."""

    def prepare(self) -> None:
        """Do nothing."""

    def feedback(self, s: Array, a: Array | None = None) -> Decision:
        """The law's action, or the one that is enforced.

        Args:
            s: State in the model's units, (n,).
            a: Action to enforce, (m,).
        """
        if a is not None:
            return Decision(a)
        problem = self.problem
        deviation = s - problem.reference_state
        correction = self.gain @ deviation
        u = problem.reference_action - correction
        action = np.clip(u, problem.action_lower, problem.action_upper)
        return Decision(action)


class PiLoops:
    """A PI loop from a state to each action, its set-point the reference; u_s is fed forward.

    `states` (m,) are the states that the actions hold (`pairing` of a sample's gains), `gain` (m,)
    and `reset_time` (m,), in samples, follow from the SIMC rules (Skogestad 2003): with the other
    states held, one answers as k/(τs + 1), and the hold delays it by θ = ½. With τ_c = θ that
    makes K = τ/k and τ_I = min(τ, 4). An action at its bound stops its integral from going further
    that way. Raises ControllerError where states and actions cannot be paired.
    """

    def __init__(self, problem: Problem) -> None:
        A, B = linear_model(problem)
        self.problem = problem
        self.states = pairing(B)
        # A sample's own dynamics of a state, the others held, are its entry of A's diagonal.
        # The clip gives an integrator a long time constant, and a state without memory a short one.
        diagonal = np.diag(A)
        poles = np.clip(diagonal, 1e-9, 1.0 - 1e-9)
        pole = poles[self.states]
        time_constant = -1.0 / np.log(pole)
        # K = τ/k with the steady gain k of an action, that of a sample over 1 − pole.
        n_actions = len(self.states)
        actions = np.arange(n_actions)
        sample_gain = B[self.states, actions]
        self.gain = time_constant * (1.0 - pole) / sample_gain
        self.reset_time = np.minimum(time_constant, 4.0)
        self.reset()

    def reset(self) -> None:
        """Empty the integrals."""
        self._integral = np.zeros(self.states.size)
        self._increment = np.zeros(self.states.size)

    def prepare(self) -> None:
        """Integrate the last sample's error."""
        self._integral = self._integral + self._increment
        self._increment = np.zeros(self.states.size)

    def feedback(self, s: Array, a: Array | None = None) -> Decision:
        """The law's action, or the one that is enforced.

        Args:
            s: State in the model's units, (n,).
            a: Action to enforce, (m,).
        """
        problem = self.problem
        errors = problem.reference_state - s
        error = errors[self.states]
        correction = self.gain * (error + self._integral)
        u = problem.reference_action + correction
        action: Array = np.clip(u, problem.action_lower, problem.action_upper)
        # At a bound the integral stops where it would push on (conditional integration).
        # The error and what the action lacks have one direction where the integral winds up.
        beyond = u - action
        winds_up = beyond * self.gain * error > 0.0
        increment = error / self.reset_time
        self._increment = np.where(winds_up, 0.0, increment)
        if a is not None:
            action = a
        return Decision(action)


def pairing(gains: Array) -> NDArray[np.intp]:
    """State of each action, (m,), by the relative gains Λ = G ∘ G⁻ᵀ closest to 1; G (n, m).

    Raises ControllerError unless G is square and regular and every λ chosen positive.
    """
    try:
        inverse = np.linalg.inv(gains)
        by_state = gains * inverse.T
        relative = by_state.T
    except np.linalg.LinAlgError:  # not square, or singular
        relative = np.zeros_like(gains.T)
    # Relative gains have no unit: they can be compared, with each other and with 1.
    distance = np.abs(relative - 1.0)
    actions, states = linear_sum_assignment(distance)
    chosen = relative[actions, states]
    if not (chosen > 0.0).all():
        n_states, n_actions = gains.shape
        raise ControllerError(
            f"{n_states} states and {n_actions} actions make no PI loops: each action needs a "
            "state of its own, and the gains of a sample must allow to pair them"
        )
    return np.asarray(states)
