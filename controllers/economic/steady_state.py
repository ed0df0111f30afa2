"""The economically optimal steady state of a problem, with multipliers and second derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import TuningError
from controllers.model import discretise
from controllers.problem import Problem

Array = NDArray[np.float64]
# A bound counts as strictly active above this share of the largest multiplier.
_STRICT = 1e-6


@dataclass(frozen=True)
class SteadyState:
    """Optimum of min ℓ(x, u) s.t. x = f(x, u) and the bounds, for the sampled nominal model.

    `x` (n,), `u` (m,), `cost` ℓ_s; `costate` λ (n,) of f(x, u) − x = 0; `multipliers` (n+m,) of the
    bounds of w = (x, u), positive at a lower and negative at an upper bound; `A` (n, n), `B` (n, m)
    Jacobians of f; `hessian` H = ∇²_w (ℓ + λᵀf) (n+m, n+m); `gradient` (n+m,) of ℓ + λᵀ(f − x),
    which equals `multipliers`. `C` (n_c, n+m) holds the gradients of the strictly active bounds
    and `active` says which they are.
    """

    x: Array
    u: Array
    cost: float
    costate: Array
    multipliers: Array
    A: Array
    B: Array
    hessian: Array
    gradient: Array
    C: Array
    active: tuple[str, ...]

    @property
    def eigenvalues(self) -> Array:
        """Eigenvalues of `hessian`, ascending."""
        return np.linalg.eigvalsh(self.hessian).astype(np.float64)


def optimal_steady_state(problem: Problem) -> SteadyState:
    """Solve for the optimal steady state with IPOPT, started from the problem's reference.

    Raises TuningError where IPOPT fails, or where a state bound's multiplier exceeds the linear
    weight of the penalty, so that the relaxed problem would rather violate the bound.
    """
    model = problem.model
    n = problem.n_states
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", problem.n_actions)
    d, p = ca.DM(model.nominal_disturbance), ca.DM(model.nominal_parameters)
    x_next = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
    cost = model.economic_cost(x, u, ca.SX(d), ca.SX(p))
    w = ca.vertcat(x, u)
    options: dict[str, Any] = {
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11, "bound_relax_factor": 0.0},
        "print_time": False,
        "error_on_fail": False,
    }
    solver = ca.nlpsol("steady_state", "ipopt", {"x": w, "f": cost, "g": x_next - x}, options)
    found = solver(
        x0=np.concatenate([problem.reference_state, problem.reference_action]),
        lbx=np.concatenate([problem.state_lower, problem.action_lower]),
        ubx=np.concatenate([problem.state_upper, problem.action_upper]),
        lbg=0.0,
        ubg=0.0,
    )
    stats = solver.stats()
    if not stats["success"]:
        raise TuningError(
            f"the optimal steady state of model '{model.name}' was not found (IPOPT: "
            f"{stats['return_status']}); check bounds, and the reference, which is its start"
        )
    point, costate = found["x"].full().reshape(-1), found["lam_g"].full().reshape(-1)
    lagrangian = cost + ca.dot(ca.SX(ca.DM(costate)), x_next - x)
    hessian, gradient = ca.hessian(lagrangian, w)
    derivatives = ca.Function("d", [w], [hessian, gradient, ca.jacobian(x_next, w)])
    hessian, gradient, jacobian = (value.full() for value in derivatives(point))
    # CasADi's bound multipliers are those of +w ≤ upper: the other sign.
    multipliers = -found["lam_x"].full().reshape(-1)
    strict = np.flatnonzero(np.abs(multipliers) > _STRICT * max(1.0, np.abs(multipliers).max()))
    for i in strict[strict < n]:
        if abs(multipliers[i]) >= problem.penalty_linear[i]:
            raise TuningError(
                f"the penalty of {model.states[i].name} is too small: its linear weight "
                f"{problem.penalty_linear[i]:g} must exceed the bound's multiplier "
                f"{abs(multipliers[i]):g}"
            )
    return SteadyState(
        x=point[:n],
        u=point[n:],
        cost=float(found["f"]),
        costate=costate,
        multipliers=multipliers,
        A=jacobian[:, :n],
        B=jacobian[:, n:],
        hessian=hessian,
        gradient=gradient.reshape(-1),
        C=np.eye(len(point))[strict],
        active=tuple(_describe(problem, int(i), bool(multipliers[i] > 0)) for i in strict),
    )


def _describe(problem: Problem, index: int, at_lower: bool) -> str:
    lower = np.concatenate([problem.state_lower, problem.action_lower])
    upper = np.concatenate([problem.state_upper, problem.action_upper])
    quantity = (*problem.model.states, *problem.model.actions)[index]
    relation, bound = ("≥", lower[index]) if at_lower else ("≤", upper[index])
    return f"{quantity.name} {relation} {bound:g} {quantity.unit}".rstrip()
