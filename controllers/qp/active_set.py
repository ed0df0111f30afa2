"""The linear system that an active set leaves of the QP: for sensitivities and for polishing."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.qp.problem import QpSolution, SoftQp

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


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


LEAST_CONTROLS = 150
"""Number of controls N·m from which the banded system is solved faster than the dense one."""


class StageMatrices(NamedTuple):
    """What a QP's KKT matrix is made of: A (N, n, n), B (N, n, m), L (N, n+m, n+m), L_N (n, n)."""

    A: Matrix
    B: Matrix
    L: Matrix
    L_N: Matrix


class _Band:
    """Where each block of every stage stands in LAPACK's band storage; for sizes n, m and N.

    Unknowns of stage k are v_k, χ_{k+1}, ξ_{k+1} and λ_{k+1}; its equations stationarity in v_k,
    the dynamics, stationarity in ξ_{k+1} and what the active set says of each row. They reach ξ_k
    to the left and v_{k+1}, χ_{k+2} to the right, so the band is one stage wide on either side.
    """

    def __init__(self, n: int, m: int, horizon: int) -> None:
        self.n, self.m, self.horizon = n, m, horizon
        self.width = m + 3 * n
        self.reach, self.size = self.width - 1, horizon * self.width
        self.v, self.chi = np.arange(m), m + np.arange(n)
        self.xi, self.lam = m + n + np.arange(n), m + 2 * n + np.arange(n)
        first = np.arange(horizon)[:, None] * self.width
        self.controls, self.rows = (first + self.v).reshape(-1), (first + self.lam).reshape(-1)

    def _at(self, rows: Index, columns: Index) -> Index:
        """Place in the flat storage, whose columns are 3·reach + 1 long."""
        place: Index = 2 * self.reach + rows - columns + columns * (3 * self.reach + 1)
        return place

    def _block(self, rows: Index, columns: Index, on: int = 0) -> Index:
        """Places of a block (rows, columns) that reaches `on` stages to the right, (stages, …)."""
        stages = np.arange(max(0, -on), self.horizon - max(0, on))[:, None, None] * self.width
        return self._at(stages + rows[:, None], stages + on * self.width + columns)

    def _diagonal(self, rows: Index, columns: Index) -> Index:
        stages = np.arange(self.horizon)[:, None] * self.width
        return self._at(stages + rows, stages + columns)

    @cached_property
    def places(self) -> dict[str, Index]:
        """Places by equation and unknown."""
        v, chi, xi, lam = self.v, self.chi, self.xi, self.lam
        return {
            "v, v": self._block(v, v),
            "v, xi": self._block(v, xi, -1),
            "v, chi": self._block(v, chi),
            "chi, v": self._block(chi, v),
            "chi, xi": self._block(chi, xi, -1),
            "chi, next xi": self._diagonal(chi, xi),
            "xi, xi": self._block(xi, xi),
            "xi, v": self._block(xi, v, 1),
            "xi, next chi": self._block(xi, chi, 1),
            "xi, chi": self._diagonal(xi, chi),
            "xi, lam": self._diagonal(xi, lam),
            "lam, xi": self._diagonal(lam, xi),
            "lam, lam": self._diagonal(lam, lam),
        }

    def filled(self, stages: StageMatrices, held: Mask, at_limit: Mask, weight: Vector) -> Matrix:
        """The band of the KKT matrix; `weight` (N, n) is 2W where a row is violated, else 0."""
        A, B, L, L_N = stages
        n = self.n
        free = ~held[:, :, None]
        state = np.concatenate([L[1:, :n, :n], L_N[None]])
        flat = np.zeros((3 * self.reach + 1) * self.size)
        blocks: dict[str, Matrix | float] = {
            "v, v": L[:, n:, n:] * free + held[:, :, None] * np.eye(self.m),
            "v, xi": (L[:, n:, :n] * free)[1:],
            "v, chi": B.transpose(0, 2, 1) * free,
            "chi, v": B,
            "chi, xi": A[1:],
            "chi, next xi": -1.0,
            "xi, xi": state,
            "xi, v": L[1:, :n, n:],
            "xi, next chi": A[1:].transpose(0, 2, 1),
            "xi, chi": -1.0,
            "xi, lam": 1.0,
            "lam, xi": np.where(at_limit, 1.0, -weight),
            "lam, lam": np.where(at_limit, 0.0, 1.0),
        }
        for name, values in blocks.items():
            flat[self.places[name]] = values
        return flat.reshape(3 * self.reach + 1, self.size, order="F")


def kkt_solve_by_stages(
    stages: StageMatrices, W: Vector, active: tuple[Mask, Mask, Mask], seeds: Matrix
) -> tuple[Matrix, Matrix] | None:
    """What `kkt_solve` gives for limits of zero, at O(N); None where the system is singular.

    W (Nn,) are the quadratic weights of the rows; `seeds` (k, Nm) the right-hand sides. Returns
    variables (k, Nm) and multipliers of the rows at their limit (k, Nn), zero elsewhere.
    """
    horizon, n, m = stages.B.shape
    held, at_limit, violated = active
    band = _band(n, m, horizon)
    weight = np.where(violated, 2 * W, 0.0).reshape(horizon, n)
    matrix = band.filled(stages, held.reshape(horizon, m), at_limit.reshape(horizon, n), weight)
    right = np.zeros((band.size, len(seeds)), order="F")
    right[band.controls] = np.where(held, 0.0, seeds).T
    _, _, answer, status = _dgbsv()(band.reach, band.reach, matrix, right, 1, 1)
    if status != 0:
        return None
    return answer[band.controls].T, np.where(at_limit, answer[band.rows].T, 0.0)


@cache
def _band(n: int, m: int, horizon: int) -> _Band:
    return _Band(n, m, horizon)


@cache
def _dgbsv() -> Callable[..., tuple[Any, Any, Matrix, int]]:
    """LAPACK's solver of banded systems, imported when it is first needed."""
    from scipy.linalg.lapack import dgbsv  # noqa: PLC0415

    solver: Callable[..., tuple[Any, Any, Matrix, int]] = dgbsv
    return solver
