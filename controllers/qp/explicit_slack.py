"""ProxQP with a persistent workspace, and any solver of qpsolvers: the slack is a variable.

min_(v,t)  ½ vᵀH v + fᵀv + wᵀt + tᵀ diag(W) t
s.t.       Γ v + t ≥ row_lower,   Γ v − t ≤ row_upper,   lower ≤ v ≤ upper,   t ≥ 0
"""

from __future__ import annotations

from typing import Any

import numpy as np
import qpsolvers
import scipy.sparse as sp
from numpy.typing import NDArray
from proxsuite import proxqp

from controllers.errors import ControllerError, QpError
from controllers.qp.active_set import polish
from controllers.qp.problem import QpSolution, SoftQp

TOLERANCE = 1e-9
GAP = 1e-7
INFINITE = 1e20
MAXIMUM, PATIENCE = 60, 5000
SOLVED = proxqp.QPSolverOutput.PROXQP_SOLVED
# Options of each attempt. ProxQP 0.8.0 takes some feasible QPs for infeasible, others with and
# without the switch.
ATTEMPTS: dict[str, list[dict[str, Any]]] = {
    "proxqp": [
        {"eps_abs": 1e-9, "eps_rel": 0.0},
        {"eps_abs": 1e-9, "eps_rel": 0.0, "primal_infeasibility_solving": True},
    ],
    # Without the gap piqp stops at multipliers that do not fit the rows' slack.
    "piqp": [
        {
            "eps_abs": 1e-10,
            "eps_rel": 1e-12,
            "check_duality_gap": True,
            "eps_duality_gap_abs": 1e-9,
            "eps_duality_gap_rel": 0.0,
        }
    ],
    "clarabel": [{"tol_gap_abs": 1e-7, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}],
    "daqp": [{"primal_tol": 1e-10, "dual_tol": 1e-12}],
}


class WithSlack:
    """Memory of the QP in (v, t): `P`, `q`, rows `C` with limits `low`, `high`, bounds `lb`, `ub`.

    `write` fills it; the rows are Γv + t, then Γv − t.
    """

    def __init__(self, variables: int, rows: int) -> None:
        size = variables + rows
        self.P, self.q = np.zeros((size, size)), np.zeros(size)
        self.C = np.zeros((2 * rows, size))
        self.C[:rows, variables:], self.C[rows:, variables:] = np.eye(rows), -np.eye(rows)
        self.low, self.high = np.full(2 * rows, -INFINITE), np.full(2 * rows, INFINITE)
        self.lb, self.ub = np.zeros(size), np.full(size, INFINITE)

    def write_matrices(self, qp: SoftQp) -> None:
        """Copy H, Γ and the quadratic weights."""
        n, rows = qp.f.size, qp.w.size
        self.P[:n, :n] = qp.H
        np.fill_diagonal(self.P[n:, n:], 2 * qp.W)
        self.C[:rows, :n] = self.C[rows:, :n] = qp.rows

    def write_vectors(self, qp: SoftQp) -> None:
        """Copy gradient, bounds and limits."""
        n, rows = qp.f.size, qp.w.size
        self.q[:n], self.q[n:] = qp.f, qp.w
        self.lb[:n], self.ub[:n] = qp.lower, qp.upper
        self.low[:rows], self.high[rows:] = qp.row_lower, qp.row_upper


class ProxQpBackend:
    """A proximal augmented Lagrangian method with warm start.

    Each solve starts from the previous solution, so it is reproducible to the tolerance only. The
    preconditioner is that of the first QP: computing it anew costs more than it saves. Where the
    warm start stalls, what it reached is polished, and if that fails the QP is solved from scratch.
    """

    def __init__(self) -> None:
        self._qp: proxqp.dense.QP | None = None
        self._data: WithSlack | None = None

    def load(self, qp: SoftQp, *, patient: bool = False) -> None:
        """Hand over the matrices; the first call allocates the workspace.

        Raises QpError where the QP is not convex, since ProxQP would return a stationary point.
        """
        qp.require_convex()
        n, rows = qp.f.size, qp.w.size
        data = self._data = self._data or WithSlack(n, rows)
        data.write_matrices(qp)
        data.write_vectors(qp)
        if self._qp is not None:
            self._qp.update(
                H=data.P, C=data.C, l_box=data.lb, u_box=data.ub, update_preconditioner=False
            )
            return
        self._qp = proxqp.dense.QP(n + rows, 0, 2 * rows, True)
        settings = self._qp.settings
        settings.eps_abs, settings.eps_rel = TOLERANCE, 0.0
        # With w = 1e5 its certificates of infeasibility hold for feasible QPs too.
        settings.eps_primal_inf = settings.eps_dual_inf = 1e-14
        # Without the gap ProxQP stops at multipliers that do not fit the rows' slack.
        settings.check_duality_gap = True
        settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = GAP, 0.0
        settings.bcl_update, settings.max_iter = not patient, PATIENCE
        settings.initial_guess = proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        self._qp.init(data.P, data.q, None, None, data.C, data.low, data.high, data.lb, data.ub)
        # An update before the first solve crashes the process (proxsuite 0.8.0).
        self._qp.solve()
        settings.bcl_update, settings.max_iter = True, MAXIMUM

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp`; raises QpError where ProxQP does not."""
        assert self._qp is not None and self._data is not None, "load comes before solve"
        data = self._data
        data.write_vectors(qp)
        self._qp.update(
            g=data.q,
            l=data.low,
            u=data.high,
            l_box=data.lb,
            u_box=data.ub,
            update_preconditioner=False,
        )
        self._qp.solve()
        answer, status = self._read(qp)
        if status != SOLVED:
            answer = polish(qp, answer)
            if not max(answer.residuals(qp)) < TOLERANCE:
                # A new workspace, by the rule of step sizes that is slow but does not stall.
                self._qp = None
                self.load(qp, patient=True)
                answer, status = self._read(qp)
                if status != SOLVED:
                    name = status.name.removeprefix("PROXQP_").lower().replace("_", " ")
                    raise QpError(f"ProxQP did not solve the QP: {name}", status=name, qp=qp.copy())
        return answer

    def _read(self, qp: SoftQp) -> tuple[QpSolution, proxqp.QPSolverOutput]:
        assert self._qp is not None
        results = self._qp.results
        return _split(results.x, results.z, qp), results.info.status


class QpsolversBackend:
    """Builds `qpsolvers.Problem` anew for each solve.

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
        problem = qpsolvers_problem(qp, dense=self._solver in qpsolvers.dense_solvers)
        rows, fixed = qp.w.size, np.flatnonzero(qp.lower == qp.upper)
        reason = "not solved"
        for options in ATTEMPTS.get(self._solver, [{}]):
            try:
                found = qpsolvers.solve_problem(problem, solver=self._solver, **options)
            except qpsolvers.QPError as error:
                reason = str(error)
                continue
            if found.found:
                z, box = np.asarray(found.z), np.asarray(found.z_box).copy()
                box[fixed] = np.asarray(found.y)
                both = np.r_[-z[:rows], z[rows:], box]
                return polish(qp, _split(np.asarray(found.x), both, qp))
        raise QpError(
            f"{self._solver} did not solve the QP: {reason}", status="not solved", qp=qp.copy()
        )


def qpsolvers_problem(qp: SoftQp, *, dense: bool = True) -> qpsolvers.Problem:
    """The QP in (v, t) as qpsolvers has it; fixed variables are equations."""
    n, rows = qp.f.size, qp.w.size
    data = WithSlack(n, rows)
    data.write_matrices(qp)
    data.write_vectors(qp)
    fixed = np.flatnonzero(qp.lower == qp.upper)
    lb, ub = data.lb, np.where(data.ub == INFINITE, np.inf, data.ub)
    lb[fixed], ub[fixed] = -np.inf, np.inf
    G, h = np.vstack([-data.C[:rows], data.C[rows:]]), np.r_[-qp.row_lower, qp.row_upper]
    A, b = np.eye(n + rows)[fixed], qp.lower[fixed]
    P, G, A = (each if dense else sp.csc_matrix(each) for each in (data.P, G, A))
    return qpsolvers.Problem(P, data.q, G, h, A, b, lb, ub)


def _split(x: NDArray[np.float64], z: NDArray[np.float64], qp: SoftQp) -> QpSolution:
    """Solution of the QP in v from that in (v, t): z holds both rows' multipliers, then bounds'."""
    n, rows = qp.f.size, qp.w.size
    return QpSolution(
        x[:n].copy(), z[2 * rows : 2 * rows + n].copy(), z[:rows] + z[rows : 2 * rows]
    )
