"""Any solver of qpsolvers, on the QP with its states kept: an independent path to the solution."""

from __future__ import annotations

from typing import Any

import numpy as np
import qpsolvers
import scipy.sparse as sp

from controllers.errors import ControllerError, QpError
from controllers.qp.active_set import polish
from controllers.qp.problem import QpSolution, SoftQp, Stages

# Options of each attempt. ProxQP 0.8.0 takes some feasible QPs for infeasible, others with and
# without the switch.
ATTEMPTS: dict[str, list[dict[str, Any]]] = {
    "proxqp": [
        {"eps_abs": 1e-9, "eps_rel": 0.0},
        {"eps_abs": 1e-9, "eps_rel": 0.0, "primal_infeasibility_solving": True},
    ],
    "piqp": [{"eps_abs": 1e-10, "eps_rel": 1e-12}],
    "clarabel": [{"tol_gap_abs": 1e-7, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}],
    "daqp": [{"primal_tol": 1e-10, "dual_tol": 1e-12}],
}


class QpsolversBackend:
    """Builds `qpsolvers.Problem` in z = (ξ_1 … ξ_N, v_0 … v_{N−1}, t) anew for each solve.

    Its solutions are polished, so that interior-point solvers, asked for what they can reach, give
    multipliers of 1e5 to the same digits as active-set ones.
    """

    def __init__(self, solver: str) -> None:
        if solver not in qpsolvers.available_solvers:
            raise ControllerError(
                f"qpsolvers has no solver '{solver}' installed; "
                f"it has {', '.join(qpsolvers.available_solvers)}"
            )
        self._solver = solver

    def load(self, qp: SoftQp) -> None:
        """Raise QpError where the QP is not convex; it is built when it is solved."""
        qp.require_convex()

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the matrices and vectors of `qp`; raises QpError where the solver does not."""
        problem, fixed = full_space(qp, dense=self._solver in qpsolvers.dense_solvers)
        reason = "not solved"
        for options in ATTEMPTS.get(self._solver, [{}]):
            try:
                solution = qpsolvers.solve_problem(problem, solver=self._solver, **options)
            except qpsolvers.QPError as error:
                reason = str(error)
                continue
            if solution.found:
                return polish(qp, _condensed(solution, qp, fixed))
        raise QpError(
            f"{self._solver} did not solve the QP: {reason}", status="not solved", qp=qp.copy()
        )


def _condensed(solution: qpsolvers.Solution, qp: SoftQp, fixed: np.ndarray) -> QpSolution:
    """The part of a full-space solution that the condensed QP asks for."""
    rows, n = qp.w.size, qp.f.size
    x, y, z, z_box = map(np.asarray, (solution.x, solution.y, solution.z, solution.z_box))
    nu = z_box[rows : rows + n].copy()
    nu[fixed] = y[y.size - fixed.size :]
    return QpSolution(x[rows : rows + n], nu, z[rows:] - z[:rows])


def full_space(qp: SoftQp, *, dense: bool) -> tuple[qpsolvers.Problem, np.ndarray]:
    """The QP with states, controls and slack as variables, and which controls are fixed.

    Needs `qp.stages`; raises ControllerError without.
    """
    if qp.stages is None:
        raise ControllerError("a full-space backend needs the QP's stages")
    stages, n, rows = qp.stages, qp.f.size, qp.w.size
    hessian, gradient = _cost(stages)
    P = sp.block_diag([hessian, sp.diags(2 * qp.W)])
    q = np.concatenate([gradient, qp.w])
    fixed = np.flatnonzero(qp.lower == qp.upper)
    picks = sp.csc_matrix(
        (np.ones(fixed.size), (np.arange(fixed.size), rows + fixed)), (fixed.size, 2 * rows + n)
    )
    dynamics, offset = _dynamics(stages)
    A = sp.vstack([sp.hstack([dynamics, sp.csc_matrix((rows, rows))]), picks])
    b = np.concatenate([offset, qp.lower[fixed]])
    eye, none = sp.eye(rows), sp.csc_matrix((rows, n))
    G = sp.vstack([sp.hstack([-eye, none, -eye]), sp.hstack([eye, none, -eye])])
    horizon = stages.A.shape[0]
    h = np.concatenate(
        [-np.tile(stages.state_lower, horizon), np.tile(stages.state_upper, horizon)]
    )
    lower, upper = qp.lower.copy(), qp.upper.copy()
    lower[fixed], upper[fixed] = -np.inf, np.inf
    lb = np.concatenate([np.full(rows, -np.inf), lower, np.zeros(rows)])
    ub = np.concatenate([np.full(rows, np.inf), upper, np.full(rows, np.inf)])
    P, A, G = (matrix.toarray() if dense else matrix.tocsc() for matrix in (P, A, G))
    return qpsolvers.Problem(P, q, G, h, A, b, lb, ub), fixed


def _cost(stages: Stages) -> tuple[sp.spmatrix, np.ndarray]:
    """Hessian and gradient in (ξ_1 … ξ_N, v_0 … v_{N−1}); ξ_0 is given."""
    horizon, n, m = stages.B.shape
    rows = horizon * n
    P = np.zeros((rows + horizon * m, rows + horizon * m))
    q = np.zeros(rows + horizon * m)
    for k in range(horizon):
        states, controls = slice((k - 1) * n, k * n), slice(rows + k * m, rows + (k + 1) * m)
        L, linear = stages.L[k], stages.q[k]
        P[controls, controls] = L[n:, n:]
        q[controls] = linear[n:]
        if k == 0:
            q[controls] += L[n:, :n] @ stages.initial
        else:
            P[states, states], P[states, controls] = L[:n, :n], L[:n, n:]
            P[controls, states] = L[n:, :n]
            q[states] = linear[:n]
    P[rows - n : rows, rows - n : rows], q[rows - n : rows] = stages.L_N, stages.q_N
    return sp.csc_matrix(P), q


def _dynamics(stages: Stages) -> tuple[sp.spmatrix, np.ndarray]:
    """Equations ξ_{k+1} − A_k ξ_k − B_k v_k = r_k."""
    horizon, n, m = stages.B.shape
    E = np.zeros((horizon * n, horizon * (n + m)))
    e = stages.r.reshape(-1).copy()
    for k in range(horizon):
        row = slice(k * n, (k + 1) * n)
        E[row, row] = np.eye(n)
        E[row, horizon * n + k * m : horizon * n + (k + 1) * m] = -stages.B[k]
        if k == 0:
            e[row] += stages.A[0] @ stages.initial
        else:
            E[row, (k - 1) * n : k * n] = -stages.A[k]
    return sp.csc_matrix(E), e
