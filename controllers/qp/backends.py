"""The solvers of a sample's QP: DAQP, and any that qpsolvers has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import daqp
import numpy as np

from controllers.errors import ControllerError, QpError
from controllers.qp.problem import NOT_CONVEX, QpSolution, SoftQp, polish

if TYPE_CHECKING:
    import qpsolvers

SOFT, FIXED = 8, 5
SETTINGS = {"primal_tol": 1e-10, "dual_tol": 1e-12}
MEANING = {
    -1: "infeasible",
    -2: "cycling",
    -3: "unbounded",
    -4: "iteration limit",
    -5: NOT_CONVEX,
    -6: "overdetermined start",
    -7: "time limit",
}


class QpBackend(Protocol):
    """A solver of `SoftQp`s of one size with finite data."""

    def load(self, qp: SoftQp) -> None:
        """Take over the matrices H, rows and weights (the preparation phase)."""

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp` and the matrices last loaded (the feedback phase).

        Raises QpError, which carries a copy of the QP, where it is not solved.
        """


def make_backend(name: str) -> QpBackend:
    """Backend by name: `daqp`, `proxqp`, or `qpsolvers:SOLVER` for any that qpsolvers has.

    Raises ControllerError on an unknown name.
    """
    kind, _, solver = name.partition(":")
    if name == "daqp":
        return DaqpBackend()
    if name == "proxqp" or (kind == "qpsolvers" and solver):
        return QpsolversBackend(solver or name)
    raise ControllerError(
        f"there is no QP backend '{name}'; choose daqp, proxqp or qpsolvers:SOLVER"
    )


class DaqpBackend:
    """Solves the condensed QP; the slack never becomes a variable.

    Every solve starts from the same empty working set, so its result depends on the QP alone and
    not on what was solved before: runs can be repeated and resumed bit by bit.
    """

    def __init__(self) -> None:
        self._model: Any = None
        self._factorised = 0
        self._failed = False

    def load(self, qp: SoftQp) -> None:
        """Factorise H and transform the rows; the first call allocates the workspace."""
        n, rows = qp.f.size, qp.w.size
        if self._model is None:
            self._lower, self._upper = np.zeros(n + rows), np.zeros(n + rows)
            self._parts = (self._lower[:n], self._upper[:n], self._lower[n:], self._upper[n:])
            self._free = np.repeat(np.array([0, SOFT], dtype=np.int32), [n, rows])
            self._sense = self._free.copy()
            self._bounds_sense = self._sense[:n]
            self._model = daqp.Model()
            self._model.settings = SETTINGS
            self._write_limits(qp)
            self._factorised, _ = self._model.setup(
                qp.H, qp.f, qp.rows, self._upper, self._lower, self._sense
            )
            self._weights(qp)
        else:
            if self._weighed[0] is not qp.w or self._weighed[1] is not qp.W:
                self._weights(qp)
            if self._failed:  # an update is refused while the limits of a failed QP stand
                self._write_limits(qp)
            self._factorised = self._model.update(
                H=qp.H, A=qp.rows, bupper=self._upper, blower=self._lower, sense=self._free
            )

    def _weights(self, qp: SoftQp) -> None:
        self._weighed = (qp.w, qp.W)
        unused = np.ones(qp.f.size)
        linear, compliance = np.r_[unused, qp.w], np.r_[unused, 0.5 / qp.W]
        self._model.soft_weights(rho_l=compliance, rho_u=compliance, w_l=linear, w_u=linear)

    def _write_limits(self, qp: SoftQp) -> None:
        lower, upper, row_lower, row_upper = self._parts
        lower[:], upper[:] = qp.lower, qp.upper
        row_lower[:], row_upper[:] = qp.row_lower, qp.row_upper

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp`; raises QpError where DAQP does not."""
        n, flag = qp.f.size, self._factorised
        self._failed = True
        if flag >= 0:
            self._write_limits(qp)
            np.multiply(qp.lower == qp.upper, FIXED, out=self._bounds_sense)
            flag = self._model.update(
                f=qp.f, bupper=self._upper, blower=self._lower, sense=self._sense
            )
        if flag >= 0:
            v, _, flag, info = self._model.solve()
        if flag <= 0:
            status = MEANING.get(flag, f"exit flag {flag}")
            raise QpError(f"DAQP did not solve the QP: {status}", status=status, qp=qp.copy())
        self._failed = False
        multipliers = info["lam"]
        return QpSolution(v, multipliers[:n], multipliers[n:])


# Options of each attempt. ProxQP 0.8.0 takes some feasible QPs for infeasible, others with and
# without the switch.
ATTEMPTS: dict[str, list[dict[str, Any]]] = {
    "proxqp": [
        {"eps_abs": 1e-9, "eps_rel": 0.0},
        {"eps_abs": 1e-9, "eps_rel": 0.0, "primal_infeasibility_solving": True},
    ],
    "clarabel": [{"tol_gap_abs": 1e-7, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}],
    "daqp": [{"primal_tol": 1e-10, "dual_tol": 1e-12}],
}


class QpsolversBackend:
    """Builds `qpsolvers.Problem` anew for each solve.

    Its solutions are polished, so that interior-point solvers, asked for what they can reach, give
    multipliers of 1e5 to the same digits as active-set ones.
    """

    def __init__(self, solver: str) -> None:
        import qpsolvers  # noqa: PLC0415 - slow to import

        if solver not in qpsolvers.available_solvers:
            raise ControllerError(
                f"qpsolvers has no solver '{solver}' installed; "
                f"it has {', '.join(qpsolvers.available_solvers)}"
            )
        self._solver = solver

    def load(self, qp: SoftQp) -> None:
        """Raise QpError where the QP is not convex; it is built when it is solved."""
        try:
            np.linalg.cholesky(qp.H)
        except np.linalg.LinAlgError as error:
            message = "the QP is not strictly convex"
            raise QpError(message, status=NOT_CONVEX, qp=qp.copy()) from error

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the matrices and vectors of `qp`; raises QpError where the solver does not."""
        import qpsolvers  # noqa: PLC0415

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
                v = np.asarray(found.x)[: qp.f.size]
                return polish(qp, QpSolution(v, box[: v.size], z[rows:] - z[:rows]))
        raise QpError(
            f"{self._solver} did not solve the QP: {reason}", status="not solved", qp=qp.copy()
        )


def qpsolvers_problem(qp: SoftQp, *, dense: bool = True) -> qpsolvers.Problem:
    """The QP in (v, t) as qpsolvers has it: the slack is a variable, fixed variables are equations.

    min_(v,t)  ½ vᵀH v + fᵀv + wᵀt + tᵀ diag(W) t
    s.t.       Γ v + t ≥ row_lower,   Γ v − t ≤ row_upper,   lower ≤ v ≤ upper,   t ≥ 0
    """
    import qpsolvers  # noqa: PLC0415
    import scipy.sparse as sp  # noqa: PLC0415

    n, rows = qp.f.size, qp.w.size
    fixed, free, unit = qp.lower == qp.upper, np.full(rows, np.inf), np.eye(rows)
    P = np.zeros((n + rows, n + rows))
    P[:n, :n], P[n:, n:] = qp.H, np.diag(2 * qp.W)
    G, h = np.block([[-qp.rows, -unit], [qp.rows, -unit]]), np.r_[-qp.row_lower, qp.row_upper]
    A, b = np.eye(n, n + rows)[fixed], qp.lower[fixed]
    lower = np.r_[np.where(fixed, -np.inf, qp.lower), np.zeros(rows)]
    upper = np.r_[np.where(fixed, np.inf, qp.upper), free]
    P, G, A = (each if dense else sp.csc_matrix(each) for each in (P, G, A))
    return qpsolvers.Problem(P, np.r_[qp.f, qp.w], G, h, A, b, lower, upper)
