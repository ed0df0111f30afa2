"""A problem's own units: what makes a change of θ large or small, however the plant is counted.

They are orders of magnitude, powers of ten, of what every problem has: the widths of its states'
bounds, the ranges of its inputs, the multipliers of the bounds that are active at its reference.
The same problem in other decimal units has the same θ but for these units.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.errors import ModelError
from controllers.model import Model
from controllers.qp.daqp_backend import FIXED, MEANING, SETTINGS

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]
ACTIVE = 1e-6
"""Share of a bound's width within which the reference counts as at the bound."""


@dataclass(frozen=True)
class Units:
    """Units `state` ρ_x (n,) and `action` ρ_u (m,), of cost κ, and `dearest` max_i μ_i ρ_i.

    μ are the multipliers of the state bounds at the reference; κ is the power of ten above
    `dearest`, so that the slack weights κ/ρ_x are exact. Where no bound is active `dearest` is 0
    and κ that of the economic cost's curvature, max_i |∂²ℓ/∂w_i²| ρ_i², or of the cost itself.
    """

    state: Vector
    action: Vector
    cost: float
    dearest: float

    @classmethod
    def of(
        cls, model: Model, lower: Vector, upper: Vector, reference: Vector, cost: float
    ) -> Units:
        """Units of a nominal model at a reference w_s = (x_s, u_s) with this cost ℓ_s.

        `lower`, `upper` and `reference` are (n+m,). Raises ModelError where the multipliers cannot
        be computed.
        """
        n = len(model.states)
        widths = upper - lower
        both = np.array([10.0**power for power in np.rint(_power(widths))])
        gradient, curvature, rates = _derivatives(model, reference)
        near = ACTIVE * widths
        below, above = reference <= lower + near, reference >= upper - near
        found = multipliers(gradient * both, rates * both, below, above)
        dearest = float(found[:n].max())
        sizes = (
            dearest,
            float(np.nan_to_num(np.abs(curvature * both**2), posinf=0.0).max()),
            abs(cost),
        )
        # What rounding leaves of a zero is none.
        least = np.finfo(np.float64).eps ** 0.5 * max(sizes)
        unit = next((_above(size) for size in sizes if size > least), 1.0)
        return cls(both[:n], both[n:], unit, dearest if dearest > least else 0.0)

    def exact(self) -> Vector:
        """Slack weights just above the multipliers, to two digits, (n,): the least exact ones.

        Where no bound is active any positive ones are: a thousandth of κ/ρ_x.
        """
        if not self.dearest:
            return 1e-3 * self.cost / self.state
        digit = 10.0 ** (np.floor(_power(self.dearest)) - 1)
        exact: Vector = (np.floor(self.dearest / digit) + 1) * digit / self.state
        return exact


def _derivatives(model: Model, reference: Vector) -> tuple[Vector, Vector, Vector]:
    """∂ℓ/∂w (n+m,), ∂²ℓ/∂w_i² (n+m,) and ∂(x')/∂w (n, n+m) at the reference."""
    x, u, d, p = model.symbols()
    w = ca.vertcat(x, u)
    hessian, gradient = ca.hessian(ca.SX(model.economic_cost(x, u, d, p)), w)
    rates = ca.jacobian(model.ode(x, u, d, p), w)
    function = ca.Function("d", [x, u, d, p], [gradient, ca.diag(hessian), rates])
    n = len(model.states)
    disturbance, parameters = model.nominal_disturbance, model.nominal_parameters
    values = function(reference[:n], reference[n:], disturbance, parameters)
    first, second, jacobian = (value.full() for value in values)
    return first.reshape(-1), second.reshape(-1), jacobian


def multipliers(gradient: Vector, rates: Vector, below: Mask, above: Mask) -> Vector:
    """|μ| (n+m,) of active bounds: least squares of ∇ℓ + (∂x')ᵀλ = μ, of the bounds' signs.

    `gradient` is ∇ℓ (n+m,), `rates` ∂x' (n, n+m); `below` and `above` say which bounds are active.
    They are those of the QP min ½|w|² + ∇ℓᵀw over what equation and active bounds leave, the
    projection of −∇ℓ on these directions. Raises ModelError where DAQP finds none.
    """
    size = np.abs(gradient).max()
    if not size or not (np.isfinite(gradient).all() and np.isfinite(rates).all()):
        return np.zeros(gradient.size)
    rows = rates / np.maximum(np.abs(rates).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    inequalities, equations = gradient.size, len(rates)
    _, _, flag, info = daqp.solve(
        np.eye(inequalities),
        gradient / size,
        rows,
        np.r_[np.where(above, 0.0, np.inf), np.zeros(equations)],
        np.r_[np.where(below, 0.0, -np.inf), np.zeros(equations)],
        np.repeat(np.array([0, FIXED], dtype=np.int32), [inequalities, equations]),
        **SETTINGS,
    )
    if flag <= 0:
        raise ModelError(
            "problem: the multipliers of the bounds at the reference cannot be computed "
            f"({MEANING.get(flag, flag)}); look at the derivatives of cost and model there"
        )
    found: Vector = np.abs(info["lam"][:inequalities]) * size
    return found


def _power(size: ArrayLike) -> Vector:
    """log10 of positive sizes, kept where products of the units are finite."""
    power: Vector = np.clip(np.log10(size), -50.0, 50.0)
    return power


def _above(size: float) -> float:
    """Power of ten above a positive size."""
    return float(10.0 ** (np.floor(_power(size)) + 1))
