"""What one feedback of the RTI-NMPC returns: action, value, and sensitivities on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from controllers.errors import ControllerError
from controllers.functions import StackedFunction
from controllers.problem import Problem
from controllers.qp.problem import QpSolution, Residuals, SoftQp
from controllers.rti.preparation import Lift, qp_of
from controllers.sensitivities import SOLUTION, adjoint_directions, curvature_directions
from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector


class LinearisationPoint(NamedTuple):
    """Where a QP is linearised: states x (N, n), actions u (N, m), costates (N, n).

    The state at stage N is not needed since the terminal cost is quadratic; the costates χ_1 … χ_N
    matter for the exact Hessian only.
    """

    x: Matrix
    u: Matrix
    costates: Matrix


@dataclass(frozen=True)
class Functions:
    """The CasADi functions that a controller of the `problem` calls.

    `preparation` and `embedding` make the QP, `readout` takes its value, `gradient` and `policy`
    its derivatives in θ (`controllers.sensitivities`), the latter made when first asked for. The
    memory of the first and the third hold a sample's QP and its solution.
    """

    problem: Problem
    preparation: StackedFunction
    embedding: StackedFunction
    readout: StackedFunction
    gradient: StackedFunction
    policy: Callable[[], StackedFunction]


Jacobians = Callable[[Vector, Vector], tuple[Matrix, Matrix] | None]
"""dπ/dθ and dπ/ds of a prepared QP and its solution by compiled code; None where it cannot."""


@dataclass(eq=False)
class Prepared:
    """What the preparation phase fixed, kept for read-outs after the next one has begun.

    `memory` is a copy of the preparation's, `parameters` the θ; `spectrum` says what convexified
    the Hessians, None for Gauss–Newton; `functions` are the maker's, and its `jacobians` where it
    is compiled.
    """

    memory: Vector
    parameters: Parameters
    spectrum: Lift | None
    functions: Functions
    jacobians: Jacobians | None = None

    def part(self, name: str) -> Vector:
        """An input, result or other part of the preparation's memory, flat."""
        return self.memory[self.functions.preparation.places[name]]

    @cached_property
    def point(self) -> LinearisationPoint:
        """Where the QP is linearised."""
        horizon = self.functions.problem.horizon
        parts = (self.part(name) for name in LinearisationPoint._fields)
        return LinearisationPoint(*(part.reshape(horizon, -1).copy() for part in parts))


@dataclass(eq=False)
class RtiSolution:
    """The solution of one QP, read as V(s) and π(s), or as Q(s, a) where u_0 = a was enforced.

    `action` (m,) is u_0; `value` is V or Q; `enforced` says which; `status` is `solved`. All
    derivatives are those of the QP that was solved, at the point where it was linearised
    (paper.tex, RTI Sensitivities); they are one-sided where `weakly_active`, and computed when they
    are asked for from `prepared` and a copy of the read-out's `memory`.
    """

    action: Vector
    value: float
    prepared: Prepared = field(repr=False)
    memory: Vector = field(repr=False)
    enforced: bool = False
    status: str = "solved"

    def _part(self, name: str) -> Matrix:
        return self.prepared.functions.readout.part(name, self.memory)

    @cached_property
    def multipliers(self) -> QpSolution:
        """Primal-dual solution of the condensed QP."""
        places = self.prepared.functions.readout.places
        return QpSolution(*(self.memory[places[name]] for name in ("v", "nu", "lam")))

    @cached_property
    def qp(self) -> SoftQp:
        """The condensed QP that was solved."""
        functions, prepared = self.prepared.functions, self.prepared
        return qp_of(functions.preparation, functions.readout, prepared.memory, self.memory)

    @cached_property
    def predicted_states(self) -> Matrix:
        """Predicted states x_0 … x_N, shape (N+1, n)."""
        return self._part("xi") + self.prepared.functions.problem.reference_state

    @cached_property
    def predicted_actions(self) -> Matrix:
        """Predicted actions u_0 … u_{N−1}, shape (N, m)."""
        reference = self.prepared.functions.problem.reference_action
        return np.asarray(self.multipliers.v.reshape(-1, reference.size) + reference)

    @property
    def unshifted(self) -> LinearisationPoint:
        """The solution as it is, as a point of linearisation for the same sample."""
        return LinearisationPoint(
            self.predicted_states[:-1], self.predicted_actions, self.costates[1:]
        )

    @property
    def slack(self) -> Matrix:
        """Slack of the soft state bounds at stages 1 … N, shape (N, n)."""
        return self._part("t")

    @property
    def costates(self) -> Matrix:
        """Multipliers χ_0 … χ_N of the initial value and the dynamics, shape (N+1, n).

        χ_0 is dV/ds or dQ/ds. At a true bound the penalty of s itself has a kink, and half of its
        slope is taken.
        """
        return self._part("chi")

    @property
    def action_gradient(self) -> Vector:
        """dQ/da, shape (m,): zero where the action was not enforced."""
        if not self.enforced:
            return np.zeros(self.action.size)
        return np.asarray(-self.multipliers.nu[: self.action.size])

    @cached_property
    def residuals(self) -> Residuals:
        """KKT residuals of the QP's solution."""
        return self.multipliers.residuals(self.qp)

    @property
    def residual(self) -> float:
        """Largest KKT residual; compiled code has measured it when it solved."""
        if self.prepared.jacobians is not None and not self.enforced:
            return float(self.memory[self.prepared.functions.readout.places["residual"]][0])
        return self.residuals.largest

    @cached_property
    def weakly_active(self) -> bool:
        """Whether a limit is about to change its activity, so that derivatives are one-sided.

        So it is too where an eigenvalue of the exact Hessian is about to be lifted.
        """
        spectrum = self.prepared.spectrum
        lifting = spectrum is not None and spectrum.undecided()
        return lifting or self.multipliers.weakly_active(self.qp)

    @cached_property
    def licq(self) -> bool:
        """Whether the active constraints' gradients are linearly independent."""
        return self.multipliers.licq_margin(self.qp) > 1e-9

    @cached_property
    def value_gradient(self) -> Vector:
        """dV/dθ or dQ/dθ, shape (n_θ,): ∇θ of the QP's Lagrangian at the solution."""
        if self.prepared.jacobians is not None:
            return self.memory[self.prepared.functions.readout.places["gradient"]]
        function = self.prepared.functions.gradient
        self._write_solution(function)
        function()
        return function.stack.copy()

    @property
    def policy_jacobian(self) -> Matrix:
        """dπ/dθ, shape (m, n_θ); raises ControllerError where the action was enforced."""
        return self._policy[0]

    @property
    def policy_state_jacobian(self) -> Matrix:
        """dπ/ds, shape (m, n); raises ControllerError where the action was enforced."""
        return self._policy[1]

    @cached_property
    def _policy(self) -> tuple[Matrix, Matrix]:
        if self.enforced:
            raise ControllerError(
                "the action was enforced, so this solution is Q(s, a) and has no policy; "
                "call feedback(s) without an action"
            )
        m, prepared = self.action.size, self.prepared
        if prepared.jacobians is not None:
            found = prepared.jacobians(prepared.memory, self.memory)
            if found is not None:
                return found
        dv, dt, dlam = adjoint_directions(self.qp, self.multipliers, m)
        function = prepared.functions.policy()
        self._write_solution(function)
        inputs = function.inputs
        for name in ("A", "B", "L", "L_N"):
            inputs[name][:] = prepared.part(name)
        for name, direction in (("dv", dv), ("dt", dt), ("dlam", dlam)):
            inputs[name][:] = direction.reshape(-1)
        if (spectrum := prepared.spectrum) is not None:
            step = self._step_from_point()
            moved = curvature_directions(self.qp.rows, dv, step, spectrum.contract)
            inputs["dM"][:] = moved.reshape(-1)
        function()
        by_theta, by_state = (function.part(name).reshape(m, -1) for name in ("policy", "state"))
        return by_theta.copy(), by_state.copy()

    def _write_solution(self, function: StackedFunction) -> None:
        """Give a read-out function the solution and the point of linearisation."""
        inputs, prepared = function.inputs, self.prepared
        places = prepared.functions.readout.places
        for name in SOLUTION:
            inputs[name][:] = self.memory[places[name]]
        for name in ("x", "u", "theta"):
            inputs[name][:] = prepared.part(name)
        if prepared.spectrum is not None:
            step = self._step_from_point()
            seed = step[:, :, None] * step[:, None, :] / 2
            inputs["M"][:] = prepared.spectrum.contract(seed).reshape(-1)
            inputs["guess"][:] = prepared.part("costates")

    def _step_from_point(self) -> Matrix:
        """Δw of each stage, shape (N, n+m)."""
        point = self.prepared.point
        return np.concatenate(
            [self.predicted_states[:-1] - point.x, self.predicted_actions - point.u], axis=1
        )
