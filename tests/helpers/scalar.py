"""A QP in one variable with a closed-form solution."""

from __future__ import annotations

import numpy as np

from controllers.qp import QpSolution, SoftQp


def scalar_qp(f: float, *, w: float = 1.0, W: float = 1.0, limit: float = 1.0) -> SoftQp:
    """min ½v² + fv + wt + Wt², |v| ≤ 10, v ≤ limit + t."""
    return SoftQp(
        H=np.eye(1),
        f=np.array([f]),
        lower=np.array([-10.0]),
        upper=np.array([10.0]),
        rows=np.ones((1, 1)),
        row_lower=np.array([-100.0]),
        row_upper=np.array([limit]),
        w=np.array([w]),
        W=np.array([W]),
    )


def solution(v: float, nu: float, lam: float) -> QpSolution:
    return QpSolution(np.array([v]), np.array([nu]), np.array([lam]))


# (f, w, W) → (v, ν, λ), by hand from v + f + ν + λ = 0 and λ = w + 2W(v − 1) where violated.
CASES = {
    "free": ((-0.5, 1.0, 1.0), (0.5, 0.0, 0.0)),
    "at the limit": ((-1.5, 1.0, 1.0), (1.0, 0.0, 0.5)),
    "violated": ((-3.0, 1.0, 1.0), (4 / 3, 0.0, 5 / 3)),
    "violated, small weight": ((-3.1, 1.0, 0.1), (23 / 12, 0.0, 71 / 60)),
    "saturated": ((-50.0, 1.0, 1.0), (10.0, 21.0, 19.0)),
    "saturated below": ((50.0, 1.0, 1.0), (-10.0, -40.0, 0.0)),
}
