"""How far the controller's Runge-Kutta steps are from the model's own solution over a sample."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ModelError, ModelWarning, warn
from controllers.problem import Problem, built_once
from controllers.qp import Mask
from cosim.core.protocols import Matrix

INTEGRATION_TOLERANCE = 0.01
"""Share of a state's range by which a sample's prediction may be off without a word."""
MAX_SUBSTEPS = 1000
"""Most substeps that are tried."""
MAX_CORNERS = 16
"""Most corners of the bounds that are tried; of more, each bound alone."""
GROWTH_MARGIN = 1e-6
"""How far above 1 a mode's growth must be to count as one: rounding is below."""


@dataclass(frozen=True)
class Integration:
    """The largest error of a sample's prediction, as a share of the ranges of the states.

    `error` is that of x₊ and, at the reference, of its derivatives by (x, u), each times the width
    of its bounds.
    `state` names the state where it is largest, `at_reference` says whether that is at the
    reference or at the bounds. `suffices` is a number of substeps, the problem's own doubled and
    doubled again, whose error is below `INTEGRATION_TOLERANCE`; None where `MAX_SUBSTEPS` is not
    enough. `unstable` says whether a mode that decays at the reference grows in the prediction.
    """

    error: float
    state: str
    at_reference: bool
    suffices: int | None
    unstable: bool

    @property
    def coarse(self) -> bool:
        """Whether the error is above `INTEGRATION_TOLERANCE`."""
        return not self.error <= INTEGRATION_TOLERANCE

    @property
    def remedy(self) -> str:
        """What mends a coarse integration, in a few words."""
        if self.suffices is None:
            return (
                f"even substeps = {MAX_SUBSTEPS} is too few: replace the fast states by what they "
                "settle at"
            )
        return f"set substeps = {self.suffices} in the table [controller]"


class _Predictor:
    """A sample of the nominal model and its derivatives, at many points at once."""

    def __init__(self, problem: Problem) -> None:
        model = problem.model
        x, u, d, p = model.symbols()
        rate = model.ode(x, u, d, p)
        point = ca.vertcat(x, u)
        jacobian = ca.jacobian(rate, point)
        slope = ca.vec(jacobian)
        results = [ca.densify(rate), ca.densify(slope)]
        rates = ca.Function("rates", [x, u, d, p], results)
        # The nominal d and p are the same at all points.
        nominal_d = ca.SX(ca.DM(model.nominal_disturbance))
        nominal_p = ca.SX(ca.DM(model.nominal_parameters))
        at_nominal: Any = rates(x, u, nominal_d, nominal_p)
        self._rates = ca.Function("rates", [x, u], at_nominal)
        self.length = problem.sampling_time / model.time_unit

    def slopes(self, x: Matrix, u: Matrix) -> tuple[Matrix, Matrix]:
        """Rates of the states and their derivatives by (x, u) at P points.

        Args:
            x: States, (P, n).
            u: Actions, (P, m).

        Returns:
            The rates (P, n), and the derivatives (P, n, n+m).
        """
        count, n = x.shape
        # CasADi has a point in each column, and stacks a derivative's columns.
        rates, slopes = self._rates(x.T, u.T)
        stacked = slopes.full().T
        by_columns = stacked.reshape(count, -1, n)
        return rates.full().T, by_columns.transpose(0, 2, 1)

    def modes(self, x: Matrix, u: Matrix) -> NDArray[np.complex128]:
        """Eigenvalues (P, n) of the rates' derivatives by x; 0 where these are not finite.

        Args:
            x: States, (P, n).
            u: Actions, (P, m).
        """
        n = x.shape[1]
        _, slopes = self.slopes(x, u)
        by_state = slopes[:, :, :n]
        # An eigenvalue solver raises its own error on what is not finite.
        usable = by_state.copy()
        usable[~_finite(by_state)] = 0.0
        eigenvalues = np.linalg.eigvals(usable)
        return eigenvalues.astype(complex)

    def __call__(
        self,
        x: Matrix,
        u: Matrix,
        substeps: int,
    ) -> Matrix:
        """x₊ and its derivatives by (x, u) side by side, (P, n, 1+n+m)."""
        count, n = x.shape
        m = u.shape[1]
        # The action is held: its own derivative by (x, u) is (0, I).
        by_state_of_held = np.zeros((m, n))
        by_action_of_held = np.eye(m)
        held_jacobian = np.hstack([by_state_of_held, by_action_of_held])
        # A state and its derivatives side by side, which the variational equation carries on.
        state = np.zeros((count, n, 1 + n + m))
        state[:, :, 0] = x
        state[:, :, 1 : 1 + n] = np.eye(n)
        h = self.length / substeps

        def rate(state: Matrix) -> Matrix:
            present_x = state[:, :, 0]
            jacobian = state[:, :, 1:]
            value, slope = self.slopes(present_x, u)
            # The variational equation: d/dt ∂x = (∂f/∂x) ∂x + (∂f/∂u) ∂u.
            by_state = slope[:, :, :n]
            by_action = slope[:, :, n:]
            from_state = by_state @ jacobian
            from_action = by_action @ held_jacobian
            variation = from_state + from_action
            column = value[:, :, None]
            return np.concatenate([column, variation], axis=2)

        for _ in range(substeps):
            k1 = rate(state)
            k2 = rate(state + h / 2 * k1)
            k3 = rate(state + h / 2 * k2)
            k4 = rate(state + h * k3)
            slopes = k1 + 2 * k2 + 2 * k3 + k4
            state = state + h / 6 * slopes
        return state


@built_once
def measure_integration(problem: Problem) -> Integration:
    """Compare a sample's prediction with those of twice, four times … as many substeps.

    That is at the reference and at corners of the bounds. A corner from which the model's own
    solution is not finite is passed over.
    """
    n = problem.n_states
    substeps = problem.substeps
    points = _points(problem)
    x = points[:, :n]
    u = points[:, n:]
    predict = _Predictor(problem)
    modes = predict.modes(x, u)
    length = predict.length
    widths = problem.upper - problem.lower
    # A derivative counts as what it makes of the whole width of the bounds.
    widths_of_states = widths[:n, None]
    scale = np.hstack([1.0, widths]) / widths_of_states
    suffices = None
    with np.errstate(all="ignore"):  # a prediction that runs away is a result here
        coarse = predict(x, u, substeps)
        present = coarse
        while substeps <= MAX_SUBSTEPS:
            finer = predict(x, u, 2 * substeps)
            grows = _grows(modes, length / substeps)
            largest = _errors(present, finer, scale, grows).max()
            # Half of the tolerance: the finer prediction, which is compared with, is off too.
            if largest <= INTEGRATION_TOLERANCE / 2:
                suffices = substeps
                break
            substeps = 2 * substeps
            present = finer
        grows = _grows(modes, length / problem.substeps)
        errors = _errors(coarse, finer, scale, grows)
    place = int(errors.argmax())
    point, state = np.unravel_index(place, errors.shape)
    return Integration(
        error=float(errors.max()),
        state=problem.model.states[state].name,
        at_reference=bool(point == 0),
        suffices=suffices,
        unstable=bool(grows[0]),
    )


def check_integration(problem: Problem) -> Integration:
    """Refuse a prediction that is unstable where the model is not; warn where it is coarse.

    Raises ModelError at a mode that decays in the model and grows in the prediction.
    """
    model = problem.model
    integration = measure_integration(problem)
    if integration.unstable:
        raise ModelError(
            f"model '{model.name}' is too stiff for substeps = {problem.substeps}: at the "
            "reference a mode that decays grows in the prediction of a sample of "
            f"{problem.sampling_time:g} s; {integration.remedy}"
        )
    if integration.coarse:
        where = "at the reference" if integration.at_reference else "at the bounds"
        # Of a prediction that runs away a number says nothing.
        size = "many times"
        if integration.error < 10:
            size = f"{100 * integration.error:.0f} % of"
        warn(
            f"model '{model.name}' is integrated coarsely by substeps = {problem.substeps}: "
            f"{where} a prediction over {problem.sampling_time:g} s is off by {size} the range of "
            f"{integration.state}; {integration.remedy}",
            ModelWarning,
        )
    return integration


def _points(problem: Problem) -> Matrix:
    """The reference, then corners of the bounds of (x, u), one a row."""
    lower = problem.lower
    upper = problem.upper
    reference = problem.reference
    # The number of corners doubles with each state and action.
    n_corners = 2 ** len(lower)
    if n_corners <= MAX_CORNERS:
        bounds = zip(lower, upper, strict=True)
        corners = list(product(*bounds))
    else:
        corners = []
        for i in range(len(lower)):
            for bound in (lower[i], upper[i]):
                corner = reference.copy()
                corner[i] = bound
                corners.append(tuple(corner))
    return np.array([reference, *corners])


def _errors(
    present: Matrix,
    finer: Matrix,
    scale: Matrix,
    grows: Mask,
) -> Matrix:
    """Errors (P, n) of predictions (P, n, 1+n+m) that have finer ones.

    Where there is no finite one the error is infinite if a mode `grows` (P,), else the solution of
    the model is not finite either, and the error is 0.
    """
    parts = np.abs(finer - present) * scale
    # Derivatives count at the reference alone: at a corner a table's kinks are no lack of substeps.
    at_reference = parts[:1].max(axis=2)
    at_corners = parts[1:, :, 0]
    errors = np.concatenate([at_reference, at_corners])
    errors = np.where(np.isfinite(errors), errors, np.inf)
    without_finer = np.where(grows, np.inf, 0.0)
    finite = _finite(finer)
    by_state = np.where(finite[:, None], errors, without_finer[:, None])
    return np.asarray(by_state)


def _finite(values: Matrix) -> Mask:
    """Whether all entries are finite, of each of P points (P, …)."""
    by_point = values.reshape(len(values), -1)
    finite = np.isfinite(by_point)
    all_finite: Mask = np.array(finite.all(axis=1))
    return all_finite


def _grows(modes: NDArray[np.complex128], h: float) -> Mask:
    """Whether of modes (P, n) one that decays is outside of the stability region of a step h."""
    # The stability function of RK4: what a step makes of a mode.
    z = modes * h
    factor = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
    growth = np.abs(factor)
    decays = modes.real < 0
    grows_in_steps = growth > 1 + GROWTH_MARGIN
    wrong = decays & grows_in_steps
    return np.asarray(wrong.any(axis=1))
