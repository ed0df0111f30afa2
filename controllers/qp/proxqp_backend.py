"""ProxQP with a persistent workspace and warm start: a proximal augmented Lagrangian method."""

from __future__ import annotations

import numpy as np
from proxsuite import proxqp

from controllers.errors import QpError
from controllers.qp.active_set import polish
from controllers.qp.problem import QpSolution, SoftQp

TOLERANCE = 1e-9
GAP = 1e-7
INFINITE = 1e20
MAXIMUM, PATIENCE = 60, 5000
SOLVED = proxqp.QPSolverOutput.PROXQP_SOLVED


class ProxQpBackend:
    """Solves the condensed QP with one explicit slack a row and box constraints.

    Each solve starts from the previous solution, so it is reproducible to the tolerance only. The
    preconditioner is that of the first QP: computing it anew costs more than it saves. Where the
    warm start stalls, what it reached is polished, and if that fails the QP is solved from scratch.
    """

    def __init__(self) -> None:
        self._qp: proxqp.dense.QP | None = None
        self._patient = False

    def load(self, qp: SoftQp) -> None:
        """Hand over the matrices; the first call allocates the workspace.

        Raises QpError where the QP is not convex, since ProxQP would return a stationary point.
        """
        qp.require_convex()
        n, rows = qp.f.size, qp.w.size
        if self._qp is None:
            self._hessian = np.zeros((n + rows, n + rows))
            self._gradient = np.zeros(n + rows)
            self._rows = np.zeros((2 * rows, n + rows))
            self._rows[:rows, n:], self._rows[rows:, n:] = np.eye(rows), -np.eye(rows)
            self._row_lower, self._row_upper = np.full((2, 2 * rows), INFINITE)
            self._row_lower *= -1
            self._lower, self._upper = np.zeros(n + rows), np.full(n + rows, INFINITE)
        self._hessian[:n, :n] = qp.H
        np.fill_diagonal(self._hessian[n:, n:], 2 * qp.W)
        self._rows[:rows, :n] = self._rows[rows:, :n] = qp.rows
        self._write_vectors(qp)
        if self._qp is None:
            self._qp = proxqp.dense.QP(n + rows, 0, 2 * rows, True)
            settings = self._qp.settings
            settings.eps_abs, settings.eps_rel = TOLERANCE, 0.0
            # With w = 1e5 its certificates of infeasibility hold for feasible QPs too.
            settings.eps_primal_inf = settings.eps_dual_inf = 1e-14
            # Without the gap ProxQP stops at multipliers that do not fit the rows' slack.
            settings.check_duality_gap = True
            settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = GAP, 0.0
            settings.bcl_update, settings.max_iter = not self._patient, PATIENCE
            settings.initial_guess = proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
            self._qp.init(
                self._hessian,
                self._gradient,
                None,
                None,
                self._rows,
                self._row_lower,
                self._row_upper,
                self._lower,
                self._upper,
            )
            # An update before the first solve crashes the process (proxsuite 0.8.0).
            self._qp.solve()
            settings.bcl_update, settings.max_iter = True, MAXIMUM
        else:
            self._qp.update(
                H=self._hessian,
                C=self._rows,
                l_box=self._lower,
                u_box=self._upper,
                update_preconditioner=False,
            )

    def _write_vectors(self, qp: SoftQp) -> None:
        n, rows = qp.f.size, qp.w.size
        self._gradient[:n], self._gradient[n:] = qp.f, qp.w
        self._lower[:n], self._upper[:n] = qp.lower, qp.upper
        self._row_lower[:rows], self._row_upper[rows:] = qp.row_lower, qp.row_upper

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp`; raises QpError where ProxQP does not."""
        n, rows = qp.f.size, qp.w.size
        self._write_vectors(qp)
        assert self._qp is not None, "load comes before solve"
        self._qp.update(
            g=self._gradient,
            l=self._row_lower,
            u=self._row_upper,
            l_box=self._lower,
            u_box=self._upper,
            update_preconditioner=False,
        )
        self._qp.solve()
        answer, status = self._read(n, rows)
        if status != SOLVED:
            answer = polish(qp, answer)
            if not max(answer.residuals(qp)) < TOLERANCE:
                answer, status = self._start_anew(qp)
                if status != SOLVED:
                    name = status.name.removeprefix("PROXQP_").lower().replace("_", " ")
                    raise QpError(f"ProxQP did not solve the QP: {name}", status=name, qp=qp.copy())
        return answer

    def _start_anew(self, qp: SoftQp) -> tuple[QpSolution, proxqp.QPSolverOutput]:
        """Solve in a new workspace by the rule of step sizes that is slow but does not stall."""
        self._qp, self._patient = None, True
        self.load(qp)
        self._patient = False
        return self._read(qp.f.size, qp.w.size)

    def _read(self, n: int, rows: int) -> tuple[QpSolution, proxqp.QPSolverOutput]:
        assert self._qp is not None, "load comes before solve"
        results = self._qp.results
        z = results.z
        solution = QpSolution(
            results.x[:n].copy(),
            z[2 * rows : 2 * rows + n].copy(),
            z[:rows] + z[rows : 2 * rows],
        )
        return solution, results.info.status
