"""The linear system that an active set leaves of the QP: for sensitivities and for polishing."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from controllers.qp.problem import QpSolution, SoftQp

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Mask = NDArray[np.bool_]
STEPS = 10


def kkt_solve(
    qp: SoftQp, active: tuple[Mask, Mask, Mask], seeds: Matrix, limits: Matrix
) -> tuple[Matrix, Matrix]:
    """Solve the KKT system of an active set for several right-hand sides, one a row.

    `active` is what `QpSolution.active` returns. Held variables stay at zero, rows at their limit
    take the values `limits` (k, rows), and a violated row adds its quadratic weight to the Hessian.
    `seeds` (k, variables) are the right-hand sides of stationarity. Returns the variables
    (k, variables) and the multipliers of the rows at their limit (k, rows), zero elsewhere. Where
    the system is singular (LICQ fails) it is solved by least squares.
    """
    held, at_limit, violated = active
    free, equal, outside = ~held, qp.rows[at_limit], qp.rows[violated]
    bound = held.any()
    H = qp.H
    if bound:
        H, equal, outside = H[free][:, free], equal[:, free], outside[:, free]
    size, count = len(H), len(equal)
    # Column-major, as LAPACK wants it.
    kkt = np.zeros((size + count, size + count), order="F")
    right = np.empty((size + count, len(seeds)), order="F")
    kkt[:size, :size] = H
    if len(outside):
        kkt[:size, :size] += 2 * (outside.T * qp.W[violated]) @ outside
    kkt[:size, size:], kkt[size:, :size] = equal.T, equal
    right[:size] = (seeds[:, free] if bound else seeds).T
    right[size:] = limits[:, at_limit].T
    answer, singular = right, False
    if len(kkt):  # every variable may be held
        _, _, answer, status = _dgesv()(kkt, right)
        singular = status != 0
    if singular:
        answer = np.asarray(np.linalg.lstsq(kkt, right)[0], dtype=np.float64)
    v, lam = np.zeros(seeds.shape), np.zeros(limits.shape)
    v[:, free], lam[:, at_limit] = answer[:size].T, answer[size:].T
    return v, lam


@cache
def _dgesv() -> Callable[..., tuple[Matrix, Matrix, Matrix, int]]:
    """LAPACK's solver, imported when it is first needed: SciPy is a quarter of a short run."""
    from scipy.linalg.lapack import dgesv  # noqa: PLC0415

    solver: Callable[..., tuple[Matrix, Matrix, Matrix, int]] = dgesv
    return solver


def polish(qp: SoftQp, solution: QpSolution, accuracy: float = 1e-10) -> QpSolution:
    """Bring an approximate solution to a residual below `accuracy` by a few Newton steps.

    A step takes the active set that the present iterate shows and solves for it exactly; near the
    solution this primal-dual active-set method (semismooth Newton on the proximal residuals) ends
    after one or two. Returns the best iterate, `solution` itself if none is better.
    """
    best, least = solution, solution.residuals(qp).largest
    for _ in range(STEPS):
        if least < accuracy:
            break
        solution = _newton_step(qp, solution)
        residual = solution.residuals(qp).largest
        if residual < least:
            best, least = solution, residual
    return best


def _newton_step(qp: SoftQp, solution: QpSolution) -> QpSolution:
    held, _, violated = active = solution.active(qp)
    upwards = solution.lam > 0
    limit = np.where(upwards, qp.row_upper, qp.row_lower)
    base = np.where(held, np.where(solution.nu > 0, qp.upper, qp.lower), 0.0)
    push = np.where(violated, np.where(upwards, qp.w, -qp.w), 0.0)
    weight = np.where(violated, 2 * qp.W, 0.0)
    fixed = qp.rows @ base - limit
    seed = -(qp.H @ base + qp.f + (push + weight * fixed) @ qp.rows)
    moved, lam = kkt_solve(qp, active, seed[None], -fixed[None])
    v = base + moved[0]
    multipliers = lam[0] + push + weight * (qp.rows @ v - limit)
    nu = np.where(held, -(qp.H @ v + qp.f + multipliers @ qp.rows), 0.0)
    return QpSolution(v, nu, multipliers)
