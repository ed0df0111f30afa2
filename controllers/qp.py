"""The QP of one sample: as mathematics, a solution's measures and active set, and its solvers."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import daqp
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ControllerError, QpError
from cosim.core.protocols import Matrix, Vector

if TYPE_CHECKING:
    import qpsolvers

Mask = NDArray[np.bool_]


NOT_CONVEX = "not convex"
"""Status of the QpError of a QP whose Hessian is not positive definite."""


@dataclass
class SoftQp:
    """A strictly convex QP with hard bounds on its variables and soft bounds on its rows.

        min_v  ½ vᵀH v + fᵀv + Σ_i w_i t_i + W_i t_i²
        s.t.   lower ≤ v ≤ upper,   row_lower − t ≤ Γ v ≤ row_upper + t,   t ≥ 0

    The stacked controls V = (v_0, …, v_{N−1}) are the variables, the predicted states Γ V the
    rows; paper.tex eq. param_nlp_qp with the dynamics eliminated. `lower = upper` fixes a variable,
    which is how u_0 = a is enforced. Shapes for d variables and c rows: H (d, d), f, lower and
    upper (d,), rows Γ (c, d), else w, W: (c,).
    """

    H: Matrix
    f: Vector
    lower: Vector
    upper: Vector
    rows: Matrix
    row_lower: Vector
    row_upper: Vector
    w: Vector
    W: Vector

    def copy(self) -> SoftQp:
        """Deep copy, for a QP that is kept beyond the next sample."""
        return copy.deepcopy(self)


class QpSolution(NamedTuple):
    """Primal-dual solution `v`, `nu`, `lam`: Hv + f + ν + Γᵀλ = 0.

    A multiplier is positive where an upper limit pushes and negative where a lower one does. ν
    belongs to the bounds; for a fixed variable it is the multiplier of that equation. λ belongs to
    the rows: |λ_i| ≤ w_i unless row i is violated, and then |λ_i| = w_i + 2 W_i t_i.
    """

    v: Vector
    nu: Vector
    lam: Vector

    def residual(self, qp: SoftQp) -> float:
        """Distance from optimality, zero exactly at the primal-dual solution.

        With σ_j the largest of |f|_j, |Hv|_j, |Γᵀλ|_j, |ν_j| and H_jj, the largest of
        |Hv + f + ν + Γᵀλ|_j / σ_j, |v − clip(v + ν/σ)|_j and |y − prox(y + λ/w)|_i / (1 + |y_i|),
        with y = Γv and the soft bound Σ t + (W/w) t²: the latter two measure feasibility, sign and
        complementarity at once. A change of the cost's unit does not change it.
        """
        v, nu, lam = self
        curvature, pull, y = qp.H @ v, lam @ qp.rows, qp.rows @ v
        terms = np.abs(np.array([qp.f, curvature, pull, nu, qp.H.diagonal()]))
        sizes = np.maximum(terms.max(axis=0), 1e-30)
        stationarity = np.abs(curvature + qp.f + nu + pull) / sizes
        bounds = np.abs(v - np.minimum(np.maximum(v + nu / sizes, qp.lower), qp.upper))
        moved = y + lam / qp.w
        nearest = np.minimum(np.maximum(moved, qp.row_lower), qp.row_upper)
        beyond = moved - nearest
        shrunk = np.maximum(np.abs(beyond) - 1.0, 0.0) / (1 + 2 * qp.W / qp.w)
        rows = np.abs(y - (nearest + np.copysign(shrunk, beyond))) / (1 + np.abs(y))
        return float(max(stationarity.max(), bounds.max(), rows.max(initial=0.0)))

    def weakly_active(self, qp: SoftQp, tolerance: float = 2e-8) -> bool:
        """Whether some bound or row is about to change its activity.

        A limit is reached within `tolerance`, relative to 1 + |limit|. It is about to change if its
        multiplier is below `tolerance`·max(‖diag H‖∞, ‖multipliers‖∞), a row's also if that is as
        close to w, or if no free variable moves the row. Derivatives of the solution are then
        one-sided.
        """
        v, nu, lam = self
        curvature = float(qp.H.diagonal().max())
        small = tolerance * max(curvature, float(np.abs(nu).max()))
        free = qp.lower != qp.upper
        at_bound = np.minimum(v - qp.lower, qp.upper - v) < tolerance * (1 + np.abs(v))
        if (free & at_bound & (np.abs(nu) < small)).any():
            return True
        y = qp.rows @ v
        at_limit = np.minimum(np.abs(y - qp.row_lower), np.abs(y - qp.row_upper)) < tolerance * (
            1 + np.abs(y)
        )
        size = np.abs(lam)
        undecided = (size < tolerance * np.maximum(curvature, size.max(initial=0.0))) | (
            np.abs(size - qp.w) < tolerance * qp.w
        )
        moved = np.abs(qp.rows[:, free]).max(axis=1, initial=0.0) > 0
        return bool((at_limit & (undecided | ~moved)).any())

    def active(self, qp: SoftQp) -> tuple[Mask, Mask, Mask]:
        """Masks: variables held by a bound, rows held at a limit, rows violated.

        They are the branches of proximal operators as in `residual`: of a distance and its
        multiplier, relative to the curvature H_jj or to w, the larger decides, which is unsafe
        where `weakly_active`.
        """
        v, nu, lam = self
        push = np.abs(nu) / np.maximum(np.abs(qp.H.diagonal()), 1e-30)
        held = (qp.lower == qp.upper) | (np.minimum(v - qp.lower, qp.upper - v) < push)
        y, size = qp.rows @ v, np.abs(lam) / qp.w
        outside = np.maximum(qp.row_lower - y, y - qp.row_upper)
        violated = size + outside > 1
        return held, ~violated & (size + outside > 0), violated

    def licq_margin(self, qp: SoftQp) -> float:
        """Least singular value of the active constraints' normalised gradients; ∞ without any.

        Zero means that the linear independence constraint qualification fails.
        """
        held, at_limit, _ = self.active(qp)
        gradients = qp.rows[at_limit][:, ~held]
        if gradients.shape[0] == 0:
            return np.inf
        if gradients.shape[0] > gradients.shape[1]:
            return 0.0
        norms = np.maximum(np.linalg.norm(gradients, axis=1, keepdims=True), 1e-300)
        return float(np.linalg.svd(gradients / norms, compute_uv=False)[-1])


TOLERANCE = 1e-8


def multipliers_at_kink(
    qp: SoftQp, solution: QpSolution, lower: Vector, upper: Vector
) -> QpSolution:
    """Of all multipliers of Q(s, a) at a kink, those that make dQ/da as small as they can.

    With u_0 = a enforced, x_1 is known. Where it lies on a soft bound, as it often does at
    a = π(s), Q has a kink: that row's multiplier may be anything in [0, w], and every backend
    returns another one. Those chosen here minimise ‖dQ/da‖ over the components of `a` strictly
    between the actuators' bounds `lower` and `upper` (m,); at a = π(s) they are those of V(s). The
    first n rows of the QP must be x_1.
    """
    v, nu, lam = solution
    m, n = lower.size, qp.w.size * lower.size // v.size
    first = qp.rows[:n, :m]
    y = first @ v[:m]
    below, above = np.abs(y - qp.row_lower[:n]), np.abs(y - qp.row_upper[:n])
    near = np.minimum(below, above) < TOLERANCE * (1 + np.abs(y))
    if not near.any():
        return solution
    rows, action, width = first[near], v[:m], TOLERANCE * (1 + np.abs(v[:m]))
    inside = (action > lower + width) & (action < upper - width)
    total = nu[:m] + lam[:n][near] @ rows
    chosen = np.linalg.lstsq(rows[:, inside].T, total[inside])[0]
    w, over = qp.w[:n][near], (above < below)[near]
    nu, lam = nu.copy(), lam.copy()
    lam[:n][near] = np.clip(chosen, np.where(over, 0, -w), np.where(over, w, 0))
    nu[:m] = total - lam[:n][near] @ rows
    return QpSolution(v, nu, lam)


STEPS = 10


def kkt_solve(
    qp: SoftQp, active: tuple[Mask, Mask, Mask], seeds: Matrix, limits: Matrix
) -> tuple[Matrix, Matrix]:
    """Solve the KKT system of an active set for several right-hand sides, one a row.

    `active` is that of `QpSolution.active`. Held variables stay at zero, rows at their limit take
    the values `limits` (k, rows), a violated row adds its quadratic weight to the Hessian. `seeds`
    (k, variables) are the right-hand sides of stationarity. Returns the variables (k, variables)
    and the multipliers of the rows at their limit (k, rows), zero elsewhere; a singular system
    (LICQ fails) is solved by least squares.
    """
    held, at_limit, violated = active
    free = ~held
    H, rows = qp.H[free][:, free], qp.rows[:, free]
    equal, outside = rows[at_limit], rows[violated]
    size, count = len(H), len(equal)
    # Column-major, as LAPACK wants it.
    kkt = np.zeros((size + count, size + count), order="F")
    right = np.empty((size + count, len(seeds)), order="F")
    kkt[:size, :size] = H
    if len(outside):
        kkt[:size, :size] += 2 * (outside.T * qp.W[violated]) @ outside
    kkt[:size, size:], kkt[size:, :size] = equal.T, equal
    right[:size] = seeds[:, free].T
    right[size:] = limits[:, at_limit].T
    answer = right
    if len(kkt):  # every variable may be held
        # SciPy is imported where it is needed: it is a quarter of a short run.
        from scipy.linalg.lapack import dgesv  # noqa: PLC0415

        _, _, answer, status = dgesv(kkt, right)
        if status != 0:
            answer = np.asarray(np.linalg.lstsq(kkt, right)[0], dtype=np.float64)
    v, lam = np.zeros(seeds.shape), np.zeros(limits.shape)
    v[:, free], lam[:, at_limit] = answer[:size].T, answer[size:].T
    return v, lam


def polish(qp: SoftQp, solution: QpSolution, accuracy: float = 1e-12) -> QpSolution:
    """Bring an approximate solution to a residual below `accuracy` by a few Newton steps.

    Each step solves exactly for the iterate's active set (a primal-dual active-set method, that is
    semismooth Newton on the proximal residuals). Returns the iterate with the least residual.
    """
    best, least = solution, solution.residual(qp)
    for _ in range(STEPS):
        if least < accuracy:
            break
        solution = _newton_step(qp, solution)
        residual = solution.residual(qp)
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
    """Solves the condensed QP, without variables for the slack.

    Every solve starts from an empty working set, so its result depends on the QP alone: runs can be
    repeated and resumed bit by bit.
    """

    _model: Any = None
    _factorised = 0
    _failed = False

    def load(self, qp: SoftQp) -> None:
        """Factorise H and transform the rows; the first call allocates the workspace."""
        n, rows = qp.f.size, qp.w.size
        if self._model is None:
            self._lower, self._upper = np.zeros((2, n + rows))
            self._free = np.repeat(np.array([0, SOFT], dtype=np.int32), [n, rows])
            self._sense = self._free.copy()
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
        n = qp.f.size
        self._lower[:n], self._lower[n:] = qp.lower, qp.row_lower
        self._upper[:n], self._upper[n:] = qp.upper, qp.row_upper

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp`; raises QpError where DAQP does not."""
        n, flag = qp.f.size, self._factorised
        self._failed = True
        if flag >= 0:
            self._write_limits(qp)
            np.multiply(qp.lower == qp.upper, FIXED, out=self._sense[:n])
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


ENOUGH = 1e-9
"""Residual of a polished solution that is one."""

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
    """Builds `qpsolvers.Problem` anew for each solve, and polishes the solution.

    So interior-point solvers give multipliers of 1e5 to the same digits as active-set ones.
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
            if found.x is None or not np.isfinite(found.x).all():
                continue
            z, box = np.asarray(found.z), np.asarray(found.z_box).copy()
            box[fixed] = np.asarray(found.y)
            v = np.asarray(found.x)[: qp.f.size]
            solution = polish(qp, QpSolution(v, box[: v.size], z[rows:] - z[:rows]))
            # A solver may say that it failed where it is near: what it says is not looked at.
            if solution.residual(qp) < ENOUGH:
                return solution
        raise QpError(
            f"{self._solver} did not solve the QP: {reason}", status="not solved", qp=qp.copy()
        )


def qpsolvers_problem(qp: SoftQp, *, dense: bool = True) -> qpsolvers.Problem:
    """The QP in (v, τ) as qpsolvers has it: the slack is a variable, fixed variables are equations.

    min_(v,τ)  ½ vᵀH v + fᵀv + wᵀt + tᵀ diag(W) t
    s.t.       Γ v + t ≥ row_lower,   Γ v − t ≤ row_upper,   lower ≤ v ≤ upper,   τ ≥ 0

    with the slack t_i = τ_i h/w_i, h = max_j H_jj, in such units that its price is h: ProxQP takes
    QPs for infeasible whose prices are many times their curvature.
    """
    import qpsolvers  # noqa: PLC0415
    import scipy.sparse as sp  # noqa: PLC0415

    n, rows = qp.f.size, qp.w.size
    fixed, free = qp.lower == qp.upper, np.full(rows, np.inf)
    slack = qp.H.diagonal().max() / qp.w
    unit = np.diag(slack)
    P = np.zeros((n + rows, n + rows))
    P[:n, :n], P[n:, n:] = qp.H, np.diag(2 * qp.W * slack**2)
    G, h = np.block([[-qp.rows, -unit], [qp.rows, -unit]]), np.r_[-qp.row_lower, qp.row_upper]
    A, b = np.eye(n, n + rows)[fixed], qp.lower[fixed]
    lower = np.r_[np.where(fixed, -np.inf, qp.lower), np.zeros(rows)]
    upper = np.r_[np.where(fixed, np.inf, qp.upper), free]
    P, G, A = (each if dense else sp.csc_matrix(each) for each in (P, G, A))
    return qpsolvers.Problem(P, np.r_[qp.f, qp.w * slack], G, h, A, b, lower, upper)
