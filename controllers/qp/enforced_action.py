"""Which multipliers to take where an enforced action makes them ambiguous."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controllers.qp.problem import QpSolution, SoftQp

Vector = NDArray[np.float64]
TOLERANCE = 1e-8


def multipliers_at_kink(
    qp: SoftQp, solution: QpSolution, lower: Vector, upper: Vector
) -> QpSolution:
    """Of all multipliers of Q(s, a) at a kink, those that make dQ/da as small as they can.

    With u_0 = a enforced, the state x_1 is known, and where it sits exactly on a soft bound Q has a
    kink: that row's multiplier may be anything in [0, w], and every backend returns another one.
    At a = π(s) this is the rule rather than the exception, since the policy drives the state to
    its bound. The multipliers chosen here minimise ‖dQ/da‖ over the components of `a` strictly
    between the actuators' bounds `lower` and `upper` (m,), so at a = π(s) they are those of V(s).
    The first n rows of the QP must be x_1; n is read off the stages that follow.
    """
    v, nu, lam = solution
    m, n = lower.size, qp.w.size * lower.size // v.size
    first = qp.rows[:n, :m]
    y = first @ v[:m]
    # Plain numbers: a few of them cost a third of what arrays do.
    limits = zip(y.tolist(), qp.row_lower[:n].tolist(), qp.row_upper[:n].tolist(), strict=True)
    if not any(
        min(abs(e - low), abs(e - high)) < TOLERANCE * (1 + abs(e)) for e, low, high in limits
    ):
        return solution
    below, above = np.abs(y - qp.row_lower[:n]), np.abs(y - qp.row_upper[:n])
    near = np.minimum(below, above) < TOLERANCE * (1 + np.abs(y))
    rows, action, width = first[near], v[:m], TOLERANCE * (1 + np.abs(v[:m]))
    inside = (action > lower + width) & (action < upper - width)
    total = nu[:m] + lam[:n][near] @ rows
    chosen = np.linalg.lstsq(rows[:, inside].T, total[inside])[0]
    w, over = qp.w[:n][near], (above < below)[near]
    nu, lam = nu.copy(), lam.copy()
    lam[:n][near] = np.clip(chosen, np.where(over, 0, -w), np.where(over, w, 0))
    nu[:m] = total - lam[:n][near] @ rows
    return QpSolution(v, nu, lam)
