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


LEAST_SIZE = 1e-30
"""Least size, so that it can divide."""
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


class ActiveSet(NamedTuple):
    """Masks of the active constraints of a `SoftQp` with d variables and c rows.

    `at_bound` (d,) are the variables at a bound, fixed ones among them; `at_limit` (c,) the rows at
    their limit, `violated` (c,) those beyond it, whose slack is positive.
    """

    at_bound: Mask
    at_limit: Mask
    violated: Mask


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
        v = self.v
        nu = self.nu
        curvature = qp.H @ v
        pull = self.lam @ qp.rows
        y = qp.rows @ v

        diagonal = qp.H.diagonal()
        terms = np.array([qp.f, curvature, pull, nu, diagonal])
        sizes = np.abs(terms).max(axis=0)
        sizes = np.maximum(sizes, LEAST_SIZE)
        gradient = curvature + qp.f + nu + pull
        stationarity = np.abs(gradient) / sizes

        # (v, ν) is optimal in the bounds exactly where v is the projection of v + ν/σ on them.
        pushed = v + nu / sizes
        projection = _projected(pushed, qp.lower, qp.upper)
        bounds = np.abs(v - projection)

        # The proximal operator of the soft bound: within the limits nothing is charged; one unit
        # of λ/w beyond them stays at the limit, and what is further out is violated.
        shifted = y + self.lam / qp.w
        nearest = _projected(shifted, qp.row_lower, qp.row_upper)
        beyond = shifted - nearest
        distance = np.abs(beyond)
        charged = np.maximum(distance - 1.0, 0.0)
        softness = 1 + 2 * qp.W / qp.w
        violation = charged / softness
        proximal = nearest + np.copysign(violation, beyond)
        error = np.abs(y - proximal)
        rows = error / (1 + np.abs(y))

        largest = max(
            stationarity.max(),
            bounds.max(),
            rows.max(initial=0.0),
        )
        return float(largest)

    def weakly_active(self, qp: SoftQp, tolerance: float = 2e-8) -> bool:
        """Whether some bound or row is about to change its activity.

        A limit is reached within `tolerance`, relative to 1 + |limit|. It is about to change if its
        multiplier is below `tolerance`·max(‖diag H‖∞, ‖multipliers‖∞), a row's also if that is as
        close to w, or if no free variable moves the row. Derivatives of the solution are then
        one-sided.

        Args:
            qp: The QP that this solves.
            tolerance: Relative distance within which a limit is reached and a multiplier zero.

        Returns:
            True where a derivative of the solution is one-sided.
        """
        v = self.v
        curvature = float(qp.H.diagonal().max())
        free = qp.lower != qp.upper

        # A variable is about to leave its bound: it is there, and ν is zero.
        nu_size = np.abs(self.nu)
        largest_nu = max(curvature, float(nu_size.max()))
        to_lower_bound = v - qp.lower
        to_upper_bound = qp.upper - v
        to_bound = np.minimum(to_lower_bound, to_upper_bound)
        at_bound = to_bound < tolerance * (1 + np.abs(v))
        no_push = nu_size < tolerance * largest_nu
        leaves_bound = free & at_bound & no_push
        if leaves_bound.any():
            return True

        # Two events: the row leaves its limit (λ = 0), or it begins to be violated (|λ| = w).
        y = qp.rows @ v
        to_lower = np.abs(y - qp.row_lower)
        to_upper = np.abs(y - qp.row_upper)
        to_limit = np.minimum(to_lower, to_upper)
        at_limit = to_limit < tolerance * (1 + np.abs(y))
        lam_size = np.abs(self.lam)
        largest = float(lam_size.max(initial=0.0))
        largest_lam = max(curvature, largest)
        leaving = lam_size < tolerance * largest_lam
        to_w = np.abs(lam_size - qp.w)
        yielding = to_w < tolerance * qp.w
        # Of a row at its limit that no free variable moves the multiplier is not unique.
        effects = np.abs(qp.rows[:, free])
        moved = effects.max(axis=1, initial=0.0) > 0
        unmoved = ~moved
        changes = at_limit & (leaving | yielding | unmoved)
        return bool(changes.any())

    def active(self, qp: SoftQp) -> ActiveSet:
        """The active set: variables at a bound, rows at a limit, rows violated.

        They are the branches of proximal operators as in `residual`: of a distance and its
        multiplier, relative to the curvature H_jj or to w, the larger decides, which is unsafe
        where `weakly_active`.
        """
        v = self.v
        curvature = np.abs(qp.H.diagonal())
        curvature = np.maximum(curvature, LEAST_SIZE)
        push = np.abs(self.nu) / curvature
        distance = np.minimum(v - qp.lower, qp.upper - v)
        fixed = qp.lower == qp.upper
        at_bound = fixed | (distance < push)

        # λ/w is 0 within the limits, between 0 and 1 at one, above 1 beyond it.
        y = qp.rows @ v
        below = qp.row_lower - y
        above = y - qp.row_upper
        outside = np.maximum(below, above)
        size = np.abs(self.lam) / qp.w
        shifted = size + outside
        violated = shifted > 1
        at_limit = ~violated & (shifted > 0)
        return ActiveSet(at_bound, at_limit, violated)

    def licq_margin(self, qp: SoftQp) -> float:
        """Least singular value of the active constraints' normalised gradients; ∞ without any.

        Zero means that the linear independence constraint qualification fails.
        """
        active = self.active(qp)
        free = ~active.at_bound
        rows_at_limit = qp.rows[active.at_limit]
        gradients = rows_at_limit[:, free]
        n_rows, n_free = gradients.shape
        if n_rows == 0:
            return np.inf
        # More gradients than dimensions are dependent, whatever they are.
        if n_rows > n_free:
            return 0.0
        norms = np.linalg.norm(gradients, axis=1, keepdims=True)
        normalised = gradients / np.maximum(norms, 1e-300)
        singular_values = np.linalg.svd(normalised, compute_uv=False)
        return float(singular_values[-1])


def _projected(
    values: Vector,
    lower: Vector,
    upper: Vector,
) -> Vector:
    """Projection of values on the box between the limits."""
    return np.minimum(np.maximum(values, lower), upper)


KINK_TOLERANCE = 1e-8
"""Relative distance within which x_1 counts as on a soft bound, and an action as on its bound."""


def multipliers_at_kink(
    qp: SoftQp,
    solution: QpSolution,
    lower: Vector,
    upper: Vector,
) -> QpSolution:
    """Of all multipliers of Q(s, a) at a kink, those that make dQ/da as small as they can.

    With u_0 = a enforced, x_1 is known. Where it lies on a soft bound, as it often does at
    a = π(s), Q has a kink: that row's multiplier may be anything in [0, w], and every backend
    returns another one. Those chosen here minimise ‖dQ/da‖ over the components of `a` strictly
    between the actuators' bounds; at a = π(s) they are those of V(s).

    Args:
        qp: The QP with u_0 fixed. Its first n rows must be x_1, its first m variables u_0.
        solution: Its solution, with any of the multipliers.
        lower: Lower bounds of the actions in units of the QP, (m,).
        upper: Their upper bounds, (m,).

    Returns:
        The solution with the multipliers chosen; `solution` itself where there is no kink.
    """
    m = lower.size
    # As many rows as states and as many variables as actions, N times each.
    n = qp.w.size * m // solution.v.size
    action = solution.v[:m]
    first_rows = qp.rows[:n, :m]
    x_1 = first_rows @ action
    to_lower = np.abs(x_1 - qp.row_lower[:n])
    to_upper = np.abs(x_1 - qp.row_upper[:n])
    to_limit = np.minimum(to_lower, to_upper)
    near = to_limit < KINK_TOLERANCE * (1 + np.abs(x_1))
    if not near.any():
        return solution

    # ν + Γᵀλ is fixed by stationarity; what the rows do not take, −ν, is dQ/da.
    kinks = np.flatnonzero(near)
    kinked_rows = first_rows[kinks]
    nu = solution.nu.copy()
    lam = solution.lam.copy()
    total = nu[:m] + lam[kinks] @ kinked_rows
    width = KINK_TOLERANCE * (1 + np.abs(action))
    above_lower = action > lower + width
    below_upper = action < upper - width
    inside = above_lower & below_upper
    effects = kinked_rows[:, inside]
    wanted, *_ = np.linalg.lstsq(effects.T, total[inside])

    # λ is in [0, w] at an upper limit, in [−w, 0] at a lower one.
    w = qp.w[kinks]
    at_upper = to_upper[kinks] < to_lower[kinks]
    lam_least = np.where(at_upper, 0, -w)
    lam_most = np.where(at_upper, w, 0)
    chosen = np.clip(wanted, lam_least, lam_most)
    lam[kinks] = chosen
    nu[:m] = total - chosen @ kinked_rows
    return QpSolution(solution.v, nu, lam)


def kkt_solve(
    qp: SoftQp,
    active: ActiveSet,
    seeds: Matrix,
    limits: Matrix,
) -> tuple[Matrix, Matrix]:
    """Solve the KKT system of an active set for several right-hand sides, one a row.

    Variables at a bound stay at zero, and a violated row adds its quadratic weight to the Hessian.
    A singular system, where LICQ fails, is solved by least squares.

    Args:
        qp: The QP with d variables and c rows.
        active: Its active set.
        seeds: Right-hand sides of stationarity, (k, d).
        limits: Values of the rows at their limit, (k, c); those of other rows are not read.

    Returns:
        The variables (k, d), and the multipliers of the rows at their limit (k, c), zero elsewhere.
    """
    at_limit = active.at_limit
    free = ~active.at_bound
    rows = qp.rows[:, free]
    equality_rows = rows[at_limit]
    violated_rows = rows[active.violated]
    H = qp.H[free][:, free]
    if len(violated_rows):
        W = qp.W[active.violated]
        weighted_rows = violated_rows.T * W
        H = H + 2 * weighted_rows @ violated_rows

    # [H Γᵀ; Γ 0] for the free variables and the rows at their limit; column-major, as LAPACK
    # wants it.
    n_free = len(H)
    n_equations = len(equality_rows)
    size = n_free + n_equations
    kkt = np.zeros((size, size), order="F")
    kkt[:n_free, :n_free] = H
    kkt[:n_free, n_free:] = equality_rows.T
    kkt[n_free:, :n_free] = equality_rows
    right = np.empty((size, len(seeds)), order="F")
    right[:n_free] = seeds[:, free].T
    right[n_free:] = limits[:, at_limit].T

    answer = right
    if size:  # every variable may be at a bound
        # SciPy is imported where it is needed: it is a quarter of a short run.
        from scipy.linalg.lapack import dgesv  # noqa: PLC0415

        _, _, answer, status = dgesv(kkt, right)
        if status != 0:
            least_squares, *_ = np.linalg.lstsq(kkt, right)
            answer = np.asarray(least_squares, dtype=np.float64)

    v = np.zeros(seeds.shape)
    v[:, free] = answer[:n_free].T
    lam = np.zeros(limits.shape)
    lam[:, at_limit] = answer[n_free:].T
    return v, lam


MAX_NEWTON_STEPS = 10
"""Most Newton steps of `polish`; two or three are the rule."""


def polish(
    qp: SoftQp,
    solution: QpSolution,
    accuracy: float = 1e-12,
) -> QpSolution:
    """Bring an approximate solution to a residual below `accuracy` by a few Newton steps.

    Each step solves exactly for the iterate's active set (a primal-dual active-set method, that is
    semismooth Newton on the proximal residuals).

    Args:
        qp: The QP.
        solution: An approximate solution, whose active set is nearly the right one.
        accuracy: Residual (`QpSolution.residual`) below which no more steps are made.

    Returns:
        The iterate with the least residual.
    """
    best = solution
    least = solution.residual(qp)
    for _ in range(MAX_NEWTON_STEPS):
        if least < accuracy:
            break
        solution = _newton_step(qp, solution)
        residual = solution.residual(qp)
        # From a wrong active set a step may lead away, or in a circle.
        if residual < least:
            best = solution
            least = residual
    return best


def _newton_step(qp: SoftQp, solution: QpSolution) -> QpSolution:
    """The KKT point of the solution's active set, whether or not it is the right one."""
    active = solution.active(qp)
    at_bound = active.at_bound
    violated = active.violated

    # The variables at a bound are known; those that are free are counted from zero.
    at_upper_bound = solution.nu > 0
    bound = np.where(at_upper_bound, qp.upper, qp.lower)
    base = np.where(at_bound, bound, 0.0)

    # λ = ±w + 2W(Γv − limit) of a violated row: the first part is known, the second is curvature.
    above = solution.lam > 0
    limit = np.where(above, qp.row_upper, qp.row_lower)
    signed_w = np.where(above, qp.w, -qp.w)
    push = np.where(violated, signed_w, 0.0)
    weight = np.where(violated, 2 * qp.W, 0.0)

    # Newton's step from `base`: stationarity in the free variables, rows at their limits met.
    excess = qp.rows @ base - limit
    base_lam = push + weight * excess
    gradient = qp.H @ base + qp.f + base_lam @ qp.rows
    # One right-hand side: a row of each.
    seeds = -gradient[None]
    limits = -excess[None]
    steps, multipliers = kkt_solve(qp, active, seeds, limits)
    step = steps[0]
    lam_at_limit = multipliers[0]
    v = base + step
    excess = qp.rows @ v - limit
    lam = lam_at_limit + push + weight * excess
    # What is left of the gradient is taken by the bounds.
    gradient = qp.H @ v + qp.f + lam @ qp.rows
    nu = np.where(at_bound, -gradient, 0.0)
    return QpSolution(v, nu, lam)


# DAQP's marks of a soft row and of an equation, its tolerances, and what its exit flags mean.
DAQP_SOFT = 8
DAQP_FIXED = 5
DAQP_SETTINGS = {"primal_tol": 1e-10, "dual_tol": 1e-12}
DAQP_STATUS = {
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
        if self._model is None:
            self._set_up(qp)
            return
        # New weights are recognised by their arrays: a comparison of values would cost more.
        if self._w is not qp.w or self._W is not qp.W:
            self._write_weights(qp)
        if self._failed:  # an update is refused while the limits of a failed QP stand
            self._write_limits(qp)
        self._factorised = self._model.update(
            H=qp.H,
            A=qp.rows,
            bupper=self._upper,
            blower=self._lower,
            sense=self._unfixed,
        )

    def _set_up(self, qp: SoftQp) -> None:
        variables = qp.f.size
        constraints = variables + qp.w.size
        # DAQP's limits are those of the variables, then those of the rows, which are soft.
        self._lower = np.zeros(constraints)
        self._upper = np.zeros(constraints)
        self._unfixed = np.zeros(constraints, dtype=np.int32)
        self._unfixed[variables:] = DAQP_SOFT
        self._sense = self._unfixed.copy()
        self._write_limits(qp)
        self._model = daqp.Model()
        self._model.settings = DAQP_SETTINGS
        self._factorised, _ = self._model.setup(
            qp.H,
            qp.f,
            qp.rows,
            self._upper,
            self._lower,
            self._sense,
        )
        self._write_weights(qp)

    def _write_weights(self, qp: SoftQp) -> None:
        self._w = qp.w
        self._W = qp.W
        # DAQP's softened constraints have the linear price w_l and the compliance rho_l = 1/(2W);
        # it wants numbers for the bounds too, which are hard, and does not read them.
        unused = np.ones(qp.f.size)
        linear = np.concatenate([unused, qp.w])
        compliance = np.concatenate([unused, 0.5 / qp.W])
        self._model.soft_weights(
            rho_l=compliance,
            rho_u=compliance,
            w_l=linear,
            w_u=linear,
        )

    def _write_limits(self, qp: SoftQp) -> None:
        variables = qp.f.size
        self._lower[:variables] = qp.lower
        self._lower[variables:] = qp.row_lower
        self._upper[:variables] = qp.upper
        self._upper[variables:] = qp.row_upper

    def solve(self, qp: SoftQp) -> QpSolution:
        """Solve with the vectors of `qp`; raises QpError where DAQP does not."""
        variables = qp.f.size
        flag = self._factorised
        # Until the end is reached: what follows may raise in several places.
        self._failed = True
        if flag >= 0:
            self._write_limits(qp)
            fixed = qp.lower == qp.upper
            np.multiply(fixed, DAQP_FIXED, out=self._sense[:variables])
            flag = self._model.update(
                f=qp.f,
                bupper=self._upper,
                blower=self._lower,
                sense=self._sense,
            )
        if flag >= 0:
            v, _, flag, info = self._model.solve()
        if flag <= 0:
            status = DAQP_STATUS.get(flag, f"exit flag {flag}")
            message = f"DAQP did not solve the QP: {status}"
            raise QpError(message, status=status, qp=qp.copy())
        self._failed = False
        multipliers = info["lam"]
        nu = multipliers[:variables]
        lam = multipliers[variables:]
        return QpSolution(v, nu, lam)


POLISHED_RESIDUAL = 1e-9
"""Largest residual of a polished solution that counts as one."""

# Options of each attempt. ProxQP 0.8.0 takes some feasible QPs for infeasible, others with and
# without the switch.
PROXQP_TOLERANCES = {"eps_abs": 1e-9, "eps_rel": 0.0}
CLARABEL_TOLERANCES = {"tol_gap_abs": 1e-7, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}
SOLVER_ATTEMPTS: dict[str, list[dict[str, Any]]] = {
    "proxqp": [
        PROXQP_TOLERANCES,
        PROXQP_TOLERANCES | {"primal_infeasibility_solving": True},
    ],
    "clarabel": [
        CLARABEL_TOLERANCES,
        # Where polishing finds no vertex from there: as near as it comes.
        {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-12, "tol_feas": 1e-11},
    ],
    "daqp": [DAQP_SETTINGS],
}


class QpsolversBackend:
    """Builds `qpsolvers.Problem` anew for each solve, and polishes the solution.

    So interior-point solvers give multipliers of 1e5 to the same digits as active-set ones.
    """

    def __init__(self, solver: str) -> None:
        import qpsolvers  # noqa: PLC0415 - slow to import

        if solver not in qpsolvers.available_solvers:
            installed = ", ".join(qpsolvers.available_solvers)
            raise ControllerError(
                f"qpsolvers has no solver '{solver}' installed; it has {installed}"
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

        dense = self._solver in qpsolvers.dense_solvers
        problem = qpsolvers_problem(qp, dense=dense)
        attempts: list[dict[str, Any]] = SOLVER_ATTEMPTS.get(self._solver, [{}])
        reason = "not solved"
        for options in attempts:
            try:
                answer = qpsolvers.solve_problem(problem, solver=self._solver, **options)
            except qpsolvers.QPError as error:
                reason = str(error)
                continue
            if answer.x is None:
                continue
            if not np.isfinite(answer.x).all():
                continue
            solution = polish(qp, _read_answer(qp, answer))
            # A solver may say that it failed where it is near: what it says is not looked at.
            if solution.residual(qp) < POLISHED_RESIDUAL:
                return solution
        message = f"{self._solver} did not solve the QP: {reason}"
        raise QpError(message, status="not solved", qp=qp.copy())


def _read_answer(qp: SoftQp, answer: qpsolvers.Solution) -> QpSolution:
    """The primal-dual solution of `qp` in that of `qpsolvers_problem(qp)`."""
    variables = qp.f.size
    rows = qp.w.size
    x = np.asarray(answer.x)
    box = np.array(answer.z_box)
    v = x[:variables]
    nu = box[:variables]
    # A fixed variable is an equation there, and its multiplier that of the equation.
    fixed = qp.lower == qp.upper
    nu[fixed] = np.asarray(answer.y)
    # Two inequalities a row: first those of the lower limits, then those of the upper ones.
    z = np.asarray(answer.z)
    below = z[:rows]
    above = z[rows:]
    return QpSolution(v, nu, above - below)


def qpsolvers_problem(qp: SoftQp, *, dense: bool = True) -> qpsolvers.Problem:
    """The QP in (v, τ) as qpsolvers has it: the slack is a variable, fixed variables are equations.

    min_(v,τ)  ½ vᵀH v + fᵀv + wᵀt + tᵀ diag(W) t
    s.t.       Γ v + t ≥ row_lower,   Γ v − t ≤ row_upper,   lower ≤ v ≤ upper,   τ ≥ 0

    with the slack t_i = τ_i h/w_i, h = max_j H_jj, in such units that its price is h: ProxQP takes
    QPs for infeasible whose prices are many times their curvature.

    Args:
        qp: The QP with d variables and c rows.
        dense: Whether the matrices are NumPy's; SciPy's sparse ones else.

    Returns:
        A problem in d + c variables.
    """
    import qpsolvers  # noqa: PLC0415
    import scipy.sparse as sp  # noqa: PLC0415

    variables = qp.f.size
    rows = qp.w.size
    size = variables + rows
    largest_curvature = qp.H.diagonal().max()
    slack_unit = largest_curvature / qp.w

    # Cost of (v, τ).
    slack_price = qp.w * slack_unit
    slack_curvature = 2 * qp.W * slack_unit**2
    P = np.zeros((size, size))
    P[:variables, :variables] = qp.H
    P[variables:, variables:] = np.diag(slack_curvature)
    q = np.concatenate([qp.f, slack_price])

    # Two inequalities a row: first those of the lower limits, then those of the upper ones.
    slack = np.diag(slack_unit)
    above_lower = [-qp.rows, -slack]
    below_upper = [qp.rows, -slack]
    G = np.block([above_lower, below_upper])
    h = np.concatenate([-qp.row_lower, qp.row_upper])

    # A fixed variable has an equation in the place of its bounds.
    fixed = qp.lower == qp.upper
    v_of_all = np.eye(variables, size)
    A = v_of_all[fixed]
    b = qp.lower[fixed]
    least_v = np.where(fixed, -np.inf, qp.lower)
    most_v = np.where(fixed, np.inf, qp.upper)
    least_slack = np.zeros(rows)
    most_slack = np.full(rows, np.inf)
    lower = np.concatenate([least_v, least_slack])
    upper = np.concatenate([most_v, most_slack])

    if not dense:
        P = sp.csc_matrix(P)
        G = sp.csc_matrix(G)
        A = sp.csc_matrix(A)
    return qpsolvers.Problem(P, q, G, h, A, b, lower, upper)
