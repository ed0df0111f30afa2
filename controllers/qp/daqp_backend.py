"""DAQP with a persistent workspace: a dual active-set method with native soft constraints."""

from __future__ import annotations

from typing import Any

import daqp
import numpy as np
from numpy.typing import NDArray

from controllers.errors import QpError
from controllers.qp import problem
from controllers.qp.problem import QpSolution, SoftQp

Matrix = NDArray[np.float64]
SOFT, FIXED = 8, 5
NOT_CONVEX = -5
SETTINGS = {"primal_tol": 1e-10, "dual_tol": 1e-12}
MEANING = {
    -1: "infeasible",
    -2: "cycling",
    -3: "unbounded",
    -4: "iteration limit",
    NOT_CONVEX: problem.NOT_CONVEX,
    -6: "overdetermined start",
    -7: "time limit",
}


class DaqpBackend:
    """Solves the condensed QP; the slack never becomes a variable.

    Every solve starts from the same empty working set, so its result depends on the QP alone and
    not on what was solved before: runs can be repeated and resumed bit by bit.
    """

    def __init__(self) -> None:
        self._model: Any = None
        self._factorised = 0
        self._limits: Matrix | None = None
        self._failed = False

    def load(self, qp: SoftQp) -> None:
        """Factorise H and transform the rows; the first call allocates the workspace.

        Where the QP brings a factor T of H, DAQP gets the QP in y with v = T y: its own
        factorisation costs O(N³), looking through the factor's rows O(N²).
        """
        if qp.factor is None:
            self._limits = None
            self._load(qp, qp.H, qp.rows)
            return
        self._limits = qp.factor()
        if np.isfinite(self._limits[0]).all():
            self._load(qp, None, self._limits)
        else:
            self._factorised = NOT_CONVEX

    def _load(self, qp: SoftQp, H: Matrix | None, A: Matrix) -> None:
        n, rows = qp.f.size, qp.w.size
        if self._model is None:
            self._lower, self._upper = np.zeros(n + rows), np.zeros(n + rows)
            self._parts = (self._lower[:n], self._upper[:n], self._lower[n:], self._upper[n:])
            self._free = np.repeat(np.array([0, SOFT], dtype=np.int32), [n, rows])
            self._sense = self._free.copy()
            self._bounds_sense, self._fixed = self._sense[:n], bytes(n)
            self._model = daqp.Model()
            self._model.settings = SETTINGS
            self._write_limits(qp)
            unit = np.eye(n) if H is None else H
            self._factorised, _ = self._model.setup(
                unit, qp.f, A, self._upper, self._lower, self._sense
            )
            self._weights(qp)
        else:
            if self._weighed[0] is not qp.w or self._weighed[1] is not qp.W:
                self._weights(qp)
            if self._failed:  # an update is refused while the limits of a failed QP stand
                self._write_limits(qp)
            self._factorised = self._model.update(
                H=H, A=A, bupper=self._upper, blower=self._lower, sense=self._free
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
        # Not by BLAS, which would start threads for a long horizon's product.
        T = None if self._limits is None else self._limits[:n]
        if flag >= 0:
            self._write_limits(qp)
            fixed = qp.lower == qp.upper
            if (told := fixed.tobytes()) != self._fixed:
                self._fixed = told
                np.multiply(fixed, FIXED, out=self._bounds_sense)
            flag = self._model.update(
                f=qp.f if T is None else np.einsum("ij,i->j", T, qp.f),
                bupper=self._upper,
                blower=self._lower,
                sense=self._sense,
            )
        if flag >= 0:
            v, _, flag, info = self._model.solve()
        if flag <= 0:
            status = MEANING.get(flag, f"exit flag {flag}")
            raise QpError(f"DAQP did not solve the QP: {status}", status=status, qp=qp.copy())
        if T is not None:
            v = np.einsum("ij,j->i", T, v)
        self._failed = False
        multipliers = info["lam"]
        return QpSolution(v, multipliers[:n], multipliers[n:])
