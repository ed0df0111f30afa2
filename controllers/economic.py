"""The NMPC cost tuned by economics, after Zanon, Gros and Diehl (2016)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import null_space, solve_discrete_are, solve_discrete_lyapunov

from controllers.errors import TuningError, TuningWarning
from controllers.model import discretise, runge_kutta
from controllers.problem import Problem, Scale
from controllers.theta import Parameters, ThetaBlocks, symmetric_matrix
from cosim.core.errors import warn
from cosim.core.protocols import Array

FORCE_WEIGHT = 1e-3
"""Price ρ of the force F at the active constraints, against the conditioning β."""
STRICTLY_ACTIVE = 1e-6
"""Share of the largest multiplier above which a bound counts as strictly active."""
UNIT_WORDS = {"%": "per cent", "1": "unit", "": "unit"}
"""Units that are not read aloud as they are written."""
LEAST_CURVATURE = 1e-2
"""Least curvature of a cost with an added quadratic, as a share of the economic cost's own size."""
LARGEST_CURVATURE = 1e4
"""Largest curvature that the least added quadratic may rely on, as a multiple of that size."""
NOTHING_ADDED = 1e-7
"""An addition below this share of that size is the solver's rounding, and none is made."""
LINEAR = 1e-9
"""Curvature, as a share of that size, below which an economic cost counts as linear."""

LEAST_SHARE = 1e-2
"""Share of the convex cost's least curvature below which the economic cost's decides nothing."""


@dataclass(frozen=True)
class SteadyState:
    """Optimum of min ℓ(x, u) s.t. x = f(x, u) and the bounds, for the sampled nominal model.

    `x` (n,), `u` (m,), `cost` ℓ_s; `costate` λ (n,) of f(x, u) − x = 0; `multipliers` (n+m,) of the
    bounds of w = (x, u), positive at a lower and negative at an upper bound, are the gradient of
    ℓ + λᵀ(f − x); `A` (n, n), `B` (n, m) Jacobians of f; `hessian` H = ∇²_w (ℓ + λᵀf) (n+m, n+m);
    `C` (n_c, n+m) gradients of the strictly active bounds, `active` these in words, `units` the
    units of w.
    """

    x: Array
    u: Array
    cost: float
    costate: Array
    multipliers: Array
    A: Array
    B: Array
    hessian: Array
    C: Array
    active: tuple[str, ...]
    units: tuple[str, ...]

    def prices(self) -> tuple[str, ...]:
        """Price of each active bound: its multiplier, the cost of a sample by a unit of it."""
        sentences = []
        multipliers = np.abs(self.C @ self.multipliers)
        for row, bound, multiplier in zip(self.C, self.active, multipliers, strict=True):
            # A row of C is the unit vector of the variable that the bound is of.
            variable = int(np.argmax(row))
            unit = self.units[variable]
            word = UNIT_WORDS.get(unit, unit)
            sentences.append(f"{bound} costs {multiplier:.3g} a {word}, each sample")
        return tuple(sentences)

    def __str__(self) -> str:
        x = _five_digits(self.x)
        u = _five_digits(self.u)
        active = ", ".join(self.active) or "no bound"
        return f"optimal steady state: x = {x}, u = {u}, cost {self.cost:.6g}, active: {active}"


def optimal_steady_state(problem: Problem) -> SteadyState:
    """Solve for the optimal steady state with IPOPT, started from the problem's reference.

    Raises TuningError where IPOPT fails, or where a state bound's multiplier exceeds the linear
    weight of the penalty, so that the relaxed problem would rather violate the bound.
    """
    model = problem.model
    n = problem.n_states
    x = ca.SX.sym("x", n)
    u = ca.SX.sym("u", problem.n_actions)
    d = ca.DM(model.nominal_disturbance)
    p = ca.DM(model.nominal_parameters)
    f = discretise(model, problem.sampling_time, problem.substeps)
    x_next = f(x, u, d, p)
    change = x_next - x
    nominal_d = ca.SX(d)
    nominal_p = ca.SX(p)
    cost = model.economic_cost(x, u, nominal_d, nominal_p)
    w = ca.vertcat(x, u)
    # Bounds are not relaxed: the active ones are read off the solution.
    options: dict[str, Any] = {
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "tol": 1e-11,
            "bound_relax_factor": 0.0,
        },
        "print_time": False,
        "error_on_fail": False,
    }
    programme = {"x": w, "f": cost, "g": change}
    solver = ca.nlpsol("steady_state", "ipopt", programme, options)
    solution = solver(
        x0=problem.reference,
        lbx=problem.lower,
        ubx=problem.upper,
        lbg=0.0,
        ubg=0.0,
    )
    stats = solver.stats()
    if not stats["success"]:
        raise TuningError(
            f"the optimal steady state of model '{model.name}' was not found (IPOPT: "
            f"{stats['return_status']}); check bounds, and the reference, which is its start"
        )

    # What is left of the gradient of cost and dynamics are the bounds' multipliers.
    point = solution["x"].full().reshape(-1)
    costate = solution["lam_g"].full().reshape(-1)
    costate_as_numbers = ca.SX(ca.DM(costate))
    lagrangian = cost + ca.dot(costate_as_numbers, change)
    hessian, gradient = ca.hessian(lagrangian, w)
    jacobian = ca.jacobian(x_next, w)
    derivatives = ca.Function("d", [w], [hessian, gradient, jacobian])
    values = derivatives(point)
    hessian, gradient, jacobian = (value.full() for value in values)
    multipliers = gradient.reshape(-1)

    # A bound that does not push takes no freedom from the feedback.
    size = np.abs(multipliers)
    least = STRICTLY_ACTIVE * max(1.0, size.max())
    strict = np.flatnonzero(size > least)
    active = [_active_bound(problem, i, multipliers[i]) for i in strict.tolist()]
    units = [quantity.unit for quantity in (*model.states, *model.actions)]
    gradients = np.eye(len(point))
    return SteadyState(
        x=point[:n],
        u=point[n:],
        cost=float(solution["f"]),
        costate=costate,
        multipliers=multipliers,
        A=jacobian[:, :n],
        B=jacobian[:, n:],
        hessian=hessian,
        C=gradients[strict],
        active=tuple(active),
        units=tuple(units),
    )


def _active_bound(
    problem: Problem,
    i: int,
    multiplier: float,
) -> str:
    """The active bound of entry i of (x, u) in words; TuningError where it would be violated."""
    model = problem.model
    quantities = (*model.states, *model.actions)
    quantity = quantities[i]
    size = abs(multiplier)
    # Bounds of states are soft: where a bound costs more than its violation, none is kept.
    if i < problem.n_states and size >= problem.penalty_linear[i]:
        raise TuningError(
            f"the penalty of {quantity.name} is too small: its linear weight "
            f"{problem.penalty_linear[i]:g} must exceed the bound's multiplier {size:g}"
        )
    if multiplier > 0:
        return f"{quantity.name} ≥ {problem.lower[i]:g} {quantity.unit}".rstrip()
    return f"{quantity.name} ≤ {problem.upper[i]:g} {quantity.unit}".rstrip()


def local_feedback(
    A: Array,
    B: Array,
    H: Array,
    C: Array,
) -> tuple[Array, Array]:
    """Gain K of u = Kx and value P of min Σ ½ wᵀHw, w = (x, u), x₊ = Ax + Bu, γ = 1.

    It solves the Riccati equation on the manifold C w_k = 0, k ≥ 1, of the active constraints. A
    row of `C` with an entry in u binds from k = 0 on, one of the state alone binds the next state.

    Args:
        A: Jacobian of the next state by the state, (n, n).
        B: Jacobian by the action, (n, m).
        H: Hessian of the stage cost, (n+m, n+m); it may be indefinite.
        C: Gradients of the active constraints, (n_c, n+m).

    Returns:
        K (m, n) and P (n, n).

    Raises:
        TuningError: The actions cannot keep the constraints, or no stabilising solution exists.
    """
    n, m = B.shape
    # What a state's constraint asks of the next state, as a constraint of (x, u).
    dynamics = np.hstack([A, B])
    C_x = C[:, :n]
    C_u = C[:, n:]
    on_action = np.abs(C_u).max(axis=1, initial=0.0) > 0
    on_next_state = C_x[~on_action] @ dynamics
    rows = np.vstack([C[on_action], on_next_state])
    by_state = rows[:, :n]
    by_action = rows[:, n:]

    # Actions that keep the constraints: u = gain x + free v.
    gain = np.zeros((m, n))
    free = np.eye(m)
    if len(rows):
        if np.linalg.matrix_rank(by_action) < len(rows):
            raise TuningError(
                f"the {len(rows)} active constraints cannot all be kept by the {m} actions within "
                "one sample: local feedback is not defined by them"
            )
        gain = -np.linalg.pinv(by_action) @ by_state
        free = null_space(by_action)
    n_free = free.shape[1]
    if n_free:
        free_gain = _unconstrained_feedback(A, B, H, gain, free)
        gain = gain + free @ free_gain

    closed_loop = A + B @ gain
    eigenvalues = np.linalg.eigvals(closed_loop)
    spectral_radius = np.abs(eigenvalues).max()
    if spectral_radius >= 1:
        raise TuningError("the active constraints, once kept, make the closed loop unstable")
    # P = stage + closedᵀ P closed: the Riccati solver's P is accurate in the gain's part only.
    identity = np.eye(n)
    along = np.vstack([identity, gain])
    stage = along.T @ H @ along
    P = solve_discrete_lyapunov(closed_loop.T, stage, method="direct")
    return gain, _symmetric(P)


def _unconstrained_feedback(
    A: Array,
    B: Array,
    H: Array,
    gain: Array,
    free: Array,
) -> Array:
    """Gain of v = Kx, where u = `gain` x + `free` v, by the Riccati equation of v."""
    n = len(A)
    count = free.shape[1]
    # In the free variables: (x, u) = change (x, v).
    identity = np.eye(n)
    zeros = np.zeros((n, count))
    state_rows = [identity, zeros]
    action_rows = [gain, free]
    change = np.block([state_rows, action_rows])
    reduced = change.T @ H @ change
    a = A + B @ gain
    b = B @ free
    q = reduced[:n, :n]
    r = reduced[n:, n:]
    s = reduced[:n, n:]
    try:
        P = solve_discrete_are(a, b, q, r, s=s)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise TuningError(
            f"the steady state has no stabilising local feedback of finite cost ({error})"
        ) from error
    # H may be indefinite, and then the equation has solutions that are no minimum.
    curvature = r + b.T @ P @ b
    eigenvalues = np.linalg.eigvalsh(_symmetric(curvature))
    if eigenvalues.min() <= 0:
        raise TuningError("the steady state is no local minimum of the economic cost")
    cross = b.T @ P @ a + s.T
    solution: Array = -np.linalg.solve(curvature, cross)
    return solution


@dataclass(frozen=True)
class Convexification:
    """H̃ = H + 𝓗(δP) + CᵀFC with I/α ⪯ H̃ ⪯ (β/α) I.

    `hessian` H̃ (n+m, n+m), `delta_P` (n, n) and `F` (n_c, n_c) are those of H̃ itself, the
    programme's divided by α.
    """

    hessian: Array
    delta_P: Array
    F: Array
    alpha: float
    beta: float


def rotation(
    A: Array,
    B: Array,
    delta_P: Array,
) -> Array:
    """𝓗(δP) = [A B]ᵀ δP [A B] − [I 0]ᵀ δP [I 0]: the storage ½xᵀδPx as a stage cost.

    Args:
        A: Jacobian of the next state by the state, (n, n).
        B: Jacobian by the action, (n, m).
        delta_P: Matrix of the storage, (n, n).
    """
    n = len(A)
    dynamics = np.hstack([A, B])
    rotated: Array = dynamics.T @ delta_P @ dynamics
    rotated[:n, :n] -= delta_P
    return rotated


def convexify(
    A: Array,
    B: Array,
    H: Array,
    C: Array,
    alpha: float | None = None,
) -> Convexification:
    """Best-conditioned convex stage cost with the same local optimum.

    With ρ = `FORCE_WEIGHT`, min β + ρ‖F‖ s.t. βI ⪰ αH + 𝓗(δP) + CᵀFC ⪰ I over α ≥ 0, β, δP and F
    (Zanon, Gros, Diehl 2016). 𝓗(δP) telescopes along a trajectory and CᵀFC vanishes where C w = 0,
    so neither changes the optimal feedback.

    Args:
        A: Jacobian of the next state by the state, (n, n).
        B: Jacobian by the action, (n, m).
        H: Hessian of the stage cost, (n+m, n+m).
        C: Gradients of the active constraints, (n_c, n+m).
        alpha: α, where it is not to be chosen.

    Raises:
        TuningError: There is no solution: the steady state is not locally optimal under these
            constraints.
    """
    size = len(H)
    n = len(A)
    n_c = len(C)
    F_basis = _symmetric_basis(n_c)
    n_F = len(F_basis)

    # The convexified Hessian is linear in α, δP and F: a column each.
    columns = _hessian_columns(H, A, B, C)
    triangle, count = columns.shape
    identity = svec(np.eye(size))[:, None]
    zeros = np.zeros((triangle, 1))

    # Variables: α, δP, F, β, t with t ≥ ‖F‖; β and t are no part of the Hessian.
    n_variables = count + 2
    F_place = slice(count - n_F, count)
    objective = np.zeros(n_variables)
    objective[-2] = 1.0
    objective[-1] = FORCE_WEIGHT
    quadratic = np.zeros((n_variables, n_variables))

    # α ≥ 0, (t, F) in the second-order cone, Hessian − I ⪰ 0, βI − Hessian ⪰ 0.
    nonnegative = np.zeros((1, n_variables))
    nonnegative[0, 0] = -1.0
    norms = [np.linalg.norm(unit) for unit in F_basis]
    norm = np.zeros((1 + n_F, n_variables))
    norm[0, -1] = -1.0
    norm[1:, F_place] = -np.diag(norms)
    above_identity = np.hstack([-columns, zeros, zeros])
    below_beta = np.hstack([columns, -identity, zeros])
    constraints = np.vstack([nonnegative, norm, above_identity, below_beta])
    no_offset = np.zeros(2 + n_F)
    minus_identity = -identity[:, 0]
    no_offset_below = np.zeros(triangle)
    offset = np.concatenate([no_offset, minus_identity, no_offset_below])
    cones = [
        clarabel.NonnegativeConeT(1),
        clarabel.SecondOrderConeT(1 + n_F),
        clarabel.PSDTriangleConeT(size),
        clarabel.PSDTriangleConeT(size),
    ]
    if alpha is not None:
        fixed = np.zeros((1, n_variables))
        fixed[0, 0] = 1.0
        constraints = np.vstack([constraints, fixed])
        offset = np.append(offset, alpha)
        cones.append(clarabel.ZeroConeT(1))
    z, status = solve_conic(quadratic, objective, constraints, offset, cones, iterations=500)
    if z is None or not z[0] > 0:
        constraint = "constraint" if n_c == 1 else "constraints"
        raise TuningError(
            f"no convex cost has the local optimum of the economic one with {n_c} active "
            f"{constraint} (Clarabel: {status}): the steady state is not optimal"
        )

    # Over α, so that H itself has the weight 1.
    alpha = float(z[0])
    delta_P = symmetric_matrix(z[1 : F_place.start], n) / alpha
    F = symmetric_matrix(z[F_place], n_c) / alpha
    hessian = _convexified(A, B, H, C, delta_P, F)
    least = np.linalg.eigvalsh(hessian)[0]
    if not least > 0:
        raise TuningError(
            f"the convexified cost is not positive definite (smallest eigenvalue {least:.3g}, "
            f"Clarabel: {status})"
        )
    return Convexification(hessian, delta_P, F, alpha, beta=float(z[-2]))


def _convexified(
    A: Array,
    B: Array,
    H: Array,
    C: Array,
    delta_P: Array,
    F: Array,
) -> Array:
    """H + 𝓗(δP) + CᵀFC, (n+m, n+m)."""
    rotated = rotation(A, B, delta_P)
    forced = C.T @ F @ C
    return _symmetric(H + rotated + forced)


def _hessian_columns(
    first: Array,
    A: Array,
    B: Array,
    C: Array,
) -> Array:
    """Derivatives of a convexified Hessian by its variables, in `svec`, side by side.

    In `svec` the cone of positive semidefinite matrices is Clarabel's.

    Args:
        first: Derivative by the first variable, which is α or σ, (n+m, n+m).
        A: Jacobian of the next state by the state, (n, n).
        B: Jacobian by the action, (n, m).
        C: Gradients of the active constraints, (n_c, n+m).

    Returns:
        A column for the first variable, and for each entry of δP and of F.
    """
    n = len(A)
    n_c = len(C)
    terms = [first]
    for unit in _symmetric_basis(n):
        terms.append(rotation(A, B, unit))
    for unit in _symmetric_basis(n_c):
        terms.append(C.T @ unit @ C)
    columns = [svec(term) for term in terms]
    return np.stack(columns, axis=1)


def _symmetric_basis(size: int) -> list[Array]:
    """Basis of the symmetric matrices: e_ij + e_ji, upper triangle row by row."""
    n_entries = size * (size + 1) // 2
    units = np.eye(n_entries)
    return [symmetric_matrix(unit, size) for unit in units]


def least_addition(
    A: Array,
    B: Array,
    H: Array,
    C: Array,
    least: float,
    largest: float,
) -> float:
    """Least σ ≥ 0 for which H + σI has a convex stage cost with the same local optimum.

    It is min σ s.t. `largest` I ⪰ H + σI + 𝓗(δP) + CᵀFC ⪰ `least` I over σ, δP and F: the
    constraints of `convexify`, with a slack.

    Args:
        A: Jacobian of the next state by the state, (n, n).
        B: Jacobian by the action, (n, m).
        H: Hessian of the stage cost, (n+m, n+m), in variables of comparable size.
        C: Gradients of the active constraints, (n_c, n+m).
        least: Least curvature of the convex cost.
        largest: Its largest curvature.

    Raises:
        TuningError: Clarabel finds none.
    """
    size = len(H)
    identity = np.eye(size)
    columns = _hessian_columns(identity, A, B, C)
    n_variables = columns.shape[1]
    objective = np.zeros(n_variables)
    objective[0] = 1.0

    # σ ≥ 0, Hessian − least I ⪰ 0, largest I − Hessian ⪰ 0.
    nonnegative = np.zeros((1, n_variables))
    nonnegative[0, 0] = -1.0
    constraints = np.vstack([nonnegative, -columns, columns])
    above = svec(H - least * identity)
    below = svec(largest * identity - H)
    offset = np.concatenate([np.zeros(1), above, below])
    cones = [
        clarabel.NonnegativeConeT(1),
        clarabel.PSDTriangleConeT(size),
        clarabel.PSDTriangleConeT(size),
    ]
    quadratic = np.zeros((n_variables, n_variables))
    z, status = solve_conic(quadratic, objective, constraints, offset, cones, iterations=500)
    if z is None:
        raise TuningError(f"the least added quadratic was not found (Clarabel: {status})")
    return max(float(z[0]), 0.0)


@dataclass(frozen=True)
class Addition:
    """The quadratic that the tuning adds to an economic cost that has no convex equal.

    It is ½ `size` Σ (Δw_i / `ranges`_i)², with Δw = (x, u) less the optimal steady state: zero at
    that state, so that this stays the optimum.

    Attributes:
        size: σ, in units of the cost.
        ranges: Ranges of (x, u), (n+m,).
        constraints: Gradients of the active bounds that the local feedback keeps, (n_c, n+m).
        released: The other active bounds, in words: no stable local feedback can keep them, too.
            Nothing pushes onto them: they are set-points, and their price is left out.
        reason: Why the economic cost could not be used as it is.
    """

    size: float
    ranges: Array
    constraints: Array
    released: tuple[str, ...]
    reason: str

    @property
    def hessian(self) -> Array:
        """Hessian of the added quadratic, (n+m, n+m)."""
        return np.diag(self.size / self.ranges**2)

    @property
    def cost_of_a_tenth(self) -> float:
        """Added cost of a sample in which one variable is a tenth of its range away."""
        return 0.5 * self.size * 0.1**2

    def __str__(self) -> str:
        if not self.size:
            text = (
                "nothing had to be added: the steady state is a vertex or the cost is flat there, "
                "and the size of the convex cost, which nothing determines, was chosen"
            )
        else:
            text = (
                "a quadratic was added: a deviation by a tenth of a range is given a cost of "
                f"{self.cost_of_a_tenth:.3g} a sample. The steady state stays; the way back to it "
                "is not the cheapest one"
            )
        if self.released:
            text += (
                f". No stable feedback stays on {', '.join(self.released)}: a set-point stands for "
                "it, and its price is left out"
            )
        return text


@dataclass(frozen=True)
class LocalTuning:
    """Result of the tuning at a steady state: a convex stage cost, its value and feedback.

    Attributes:
        convexification: The convex stage cost.
        constraints: Gradients of the active bounds that are kept, (n_c, n+m).
        economic: Feedback gain (m, n) of the economic cost, with what was added to it.
        tuned: Feedback gain (m, n) of the convex one.
        value: P (n, n), Hessian of the convex cost's value under γ = 1.
        addition: What was added; None where nothing was.
    """

    convexification: Convexification
    constraints: Array
    economic: Array
    tuned: Array
    value: Array
    addition: Addition | None


def _scaled_cost(steady: SteadyState, ranges: Array) -> tuple[Array, float]:
    """Hessian (n+m, n+m) of the economic cost in w_i / range_i, and the size of the cost there.

    The size is that of the gradient, which is all that a linear cost has, or of the curvature.
    """
    H = steady.hessian * np.outer(ranges, ranges)
    curvature = np.abs(H).max()

    # The gradient by stationarity: the multipliers of the bounds, and those of x₊ = x.
    n = len(steady.x)
    by_state = steady.A - np.eye(n)
    by_action = steady.B
    drift = np.hstack([by_state, by_action])
    gradient = steady.multipliers - drift.T @ steady.costate
    slope = np.abs(gradient * ranges).max()

    size = float(max(slope, curvature))
    # A cost that is constant has no size; it is in its own unit.
    if size == 0.0:
        size = 1.0
    return H, size


def _deviations(problem: Problem) -> Array:
    """Deviations of (x, u) that weigh the same where the cost is made convex, (n+m,).

    They are what the model states of its quantities, and the widths of the bounds where it states
    none. Both change with the units, so that the tuned cost is the same in any.
    """
    deviations = Scale.from_problem(problem).ranges.copy()
    model = problem.model
    quantities = (*model.states, *model.actions)
    for i, quantity in enumerate(quantities):
        if quantity.deviation is not None:
            deviations[i] = quantity.deviation
    return deviations


def _local_tuning(problem: Problem, steady: SteadyState) -> LocalTuning:
    """The tuning of the economic cost as it is; TuningError where no convex cost is its equal."""
    C = steady.C
    ranges = Scale.from_problem(problem).ranges
    H_of_ranges, size = _scaled_cost(steady, ranges)
    curvature = np.abs(H_of_ranges).max()
    if curvature < LINEAR * size:
        # αH is zero: nothing determines α, and the solver's rounding would be the cost's size.
        raise TuningError("the cost is linear, so that no curvature says how to come back to it")
    # βI ⪰ H̃ ⪰ I compares variables with each other, which needs a size of each.
    deviations = _deviations(problem)
    A, B = _scaled_dynamics(steady, deviations)
    H, _ = _scaled_cost(steady, deviations)
    # The economic cost's feedback is what the tuned one must equal: the certificate.
    economic, _ = local_feedback(A, B, H, C)
    convex = convexify(A, B, H, C)
    share = convex.alpha * np.abs(H).max()
    if share < LEAST_SHARE:
        # 𝓗(δP) + CᵀFC is convex without H: the best α is zero, and the solver's is its rounding.
        raise TuningError(
            "the steady state is a vertex: its active bounds alone say how to come back to it"
        )
    tuned, P = local_feedback(A, B, convex.hessian, C)
    scaled = LocalTuning(convex, C, economic, tuned, P, None)
    return _in_units_of_the_problem(scaled, deviations, cost=1.0)


def _augmented_tuning(
    problem: Problem,
    steady: SteadyState,
    reason: str,
) -> LocalTuning:
    """The tuning of the economic cost with the least quadratic added; TuningError if none helps.

    All is computed in w_i / range_i: there one σ serves every variable, and a change of units
    changes nothing.
    """
    ranges = Scale.from_problem(problem).ranges
    A, B = _scaled_dynamics(steady, ranges)
    H, size = _scaled_cost(steady, ranges)
    # C's rows are unit vectors, of which a scaling changes the length alone.
    C, released = _keepable_constraints(A, B, steady, ranges)

    # In units of the size, so that the solver's tolerances mean what they say.
    relative = least_addition(A, B, H / size, C, LEAST_CURVATURE, LARGEST_CURVATURE)
    if relative < NOTHING_ADDED:
        relative = 0.0
    sigma = size * relative
    augmented = H + sigma * np.eye(len(H))
    # Half of the curvature leaves the conditioning some room.
    least = 0.5 * LEAST_CURVATURE * size
    in_units_of_least = augmented / least
    convex = convexify(A, B, in_units_of_least, C, alpha=1.0)
    economic, _ = local_feedback(A, B, in_units_of_least, C)
    tuned, P = local_feedback(A, B, convex.hessian, C)
    addition = Addition(sigma, ranges, C, released, reason)
    scaled = LocalTuning(convex, C, economic, tuned, P, addition)
    return _in_units_of_the_problem(scaled, ranges, cost=least)


def _scaled_dynamics(steady: SteadyState, scale: Array) -> tuple[Array, Array]:
    """A (n, n) and B (n, m) in w_i / scale_i."""
    n = len(steady.x)
    x_scale = scale[:n]
    u_scale = scale[n:]
    A = steady.A * x_scale / x_scale[:, None]
    B = steady.B * u_scale / x_scale[:, None]
    return A, B


def _in_units_of_the_problem(
    scaled: LocalTuning,
    scale: Array,
    cost: float,
) -> LocalTuning:
    """A tuning in w_i / `scale`_i, its costs counted in `cost`, in the problem's own units."""
    n = len(scaled.value)
    x_scale = scale[:n]
    u_scale = scale[n:]
    F_scale = scaled.constraints @ scale
    convex = scaled.convexification
    of_problem = Convexification(
        hessian=cost * convex.hessian / np.outer(scale, scale),
        delta_P=cost * convex.delta_P / np.outer(x_scale, x_scale),
        F=cost * convex.F / np.outer(F_scale, F_scale),
        alpha=convex.alpha,
        beta=convex.beta,
    )
    gain_scale = u_scale[:, None] / x_scale
    return dataclasses.replace(
        scaled,
        convexification=of_problem,
        economic=scaled.economic * gain_scale,
        tuned=scaled.tuned * gain_scale,
        value=cost * scaled.value / np.outer(x_scale, x_scale),
    )


def _keepable_constraints(
    A: Array,
    B: Array,
    steady: SteadyState,
    ranges: Array,
) -> tuple[Array, tuple[str, ...]]:
    """Active bounds that a stable local feedback can keep, (n_c, n+m), and the others in words.

    The bound with the least price over its range is given up first. Raises TuningError where the
    actions do not stabilise the plant at all.
    """
    multipliers_of_ranges = steady.multipliers * ranges
    prices = np.abs(steady.C @ multipliers_of_ranges)
    dearest_first = np.argsort(-prices, kind="stable")
    order = [int(i) for i in dearest_first]
    # Any convex cost shows whether a stable feedback keeps the bounds.
    identity = np.eye(len(ranges))
    for count in range(len(order), -1, -1):
        kept = sorted(order[:count])
        try:
            local_feedback(A, B, identity, steady.C[kept])
        except TuningError:
            if count == 0:
                raise
            continue
        released = [steady.active[i] for i in sorted(order[count:])]
        return steady.C[kept], tuple(released)
    raise AssertionError("the loop ends by a return or an error")


@dataclass(frozen=True)
class EconomicTuning:
    """Tuned θ with its certificate.

    `economic` is the local feedback gain (m, n) of the economic cost itself (γ = 1, active
    constraints kept), `tuned` that of the convexified one. Where no convex cost has the economic
    one's local optimum, `addition` is the least quadratic that was added to it, and `economic` is
    the gain with it; else it is None.
    """

    parameters: Parameters
    steady_state: SteadyState
    convexification: Convexification
    economic: Array
    tuned: Array
    addition: Addition | None = None

    @property
    def gain_error(self) -> float:
        """Largest difference between the tuned local feedback gain and the economic one."""
        difference = np.abs(self.tuned - self.economic)
        return float(difference.max())

    def __str__(self) -> str:
        steady = self.steady_state
        lines = [
            f"optimal steady state  x = {_five_digits(steady.x)}, u = {_five_digits(steady.u)}",
            f"its cost              {steady.cost:.6g} a sample",
        ]
        for sentence in steady.prices():
            lines.append(f"active bound          {sentence}")
        if not steady.active:
            lines.append("active bound          none")
        if self.addition is None:
            lines.append("added quadratic       none: the economic cost is tuned as it is")
        else:
            lines.append(f"added quadratic       {self.addition}")
        return "\n".join(lines)


def tune(problem: Problem, blocks: ThetaBlocks | None = None) -> EconomicTuning:
    """Tune the NMPC: its local feedback becomes the economic optimum's (docs/method.md).

    ℓ_θ = ½ΔwᵀMΔw + qᵀΔw with M = H̃ + (1−γ)[A B]ᵀP[A B] and V^f_θ = ½ΔxᵀPΔx + q_xᵀΔx: H̃ is the
    convexified Hessian, q the gradient along the active constraints, P the value of H̃ under γ = 1.
    λ_θ undoes the rotations by costate and storage, so that V_θ is to second order the economic
    value; c_λ is ℓ_s. θ is rounded to six digits.

    Where no convex cost has the economic one's local optimum, the least quadratic is added to it,
    and a TuningWarning says so once (docs/how-to/your-plant.md).

    Args:
        problem: The control problem.
        blocks: The blocks of θ; the paper's where they are None.

    Raises:
        TuningError: There is no steady state, a penalty is too small, or no action stabilises the
            plant.
    """
    # The certificate compares gains, which need A and B to more digits than a controller does.
    substeps = linearisation_substeps(problem)
    steady = optimal_steady_state(dataclasses.replace(problem, substeps=substeps))
    try:
        local = _local_tuning(problem, steady)
    except TuningError as reason:
        try:
            local = _augmented_tuning(problem, steady, str(reason))
        except TuningError as error:
            raise TuningError(
                f"{error}. {steady}. Look at the model and its bounds there: no quadratic cost "
                "helps"
            ) from error
    if local.addition is not None:
        warn(f"model '{problem.model.name}': {local.addition}", TuningWarning)
    n = problem.n_states
    convex = local.convexification
    P = local.value
    # P is the value under γ = 1: what γ < 1 takes of the next state's, the stage cost has too.
    dynamics = np.hstack([steady.A, steady.B])
    taken = 1.0 - problem.discount
    M = convex.hessian + taken * dynamics.T @ P @ dynamics
    q = steady.multipliers
    if local.addition is not None and local.addition.released:
        # What pushes onto a bound that cannot be kept would make the loop unstable.
        q = q * local.constraints.any(axis=0)
    q_x = q[:n]
    C_x = local.constraints[:, :n]
    # The storage, less what F costs at stage 0, whose state need not keep the constraints.
    initial = convex.delta_P - C_x.T @ convex.F @ C_x

    # θ's quadratics are about the reference, the tuning's about the optimal steady state.
    steady_point = np.concatenate([steady.x, steady.u])
    shift = problem.reference - steady_point
    shift_x = shift[:n]
    values = {
        "B_l": _symmetric(0.5 * M),
        "b_l": q + M @ shift,
        "B_Vf": _symmetric(0.5 * P),
        "b_Vf": q_x + P @ shift_x,
        "B_lambda": _symmetric(0.5 * initial),
        "b_lambda": steady.costate + initial @ shift_x,
    }
    ranges = Scale.from_problem(problem).ranges
    rounded = {}
    for name, value in values.items():
        # A block is of states, or of states and actions.
        ranges_of_block = ranges[: len(value)]
        rounded[name] = _rounded(value, ranges_of_block)
    return EconomicTuning(
        parameters=Parameters.naive(problem, blocks).replace(rounded),
        steady_state=steady,
        convexification=convex,
        economic=local.economic,
        tuned=local.tuned,
        addition=local.addition,
    )


def linearisation_substeps(problem: Problem) -> int:
    """Runge–Kutta steps a sample with a relative error below 1e-8, at the reference.

    The error is that of A and B. The problem's own number is doubled until doubling it once more
    changes less. Raises TuningError where 1024 steps are too few.
    """
    model = problem.model
    n = problem.n_states
    m = problem.n_actions
    x, u, d, p = model.symbols()
    h = ca.SX.sym("h")

    def rate(state: ca.SX) -> ca.SX:
        return model.ode(state, u, d, p)

    after = runge_kutta(rate, x, h, 1)
    point = ca.vertcat(x, u)
    by_point = ca.jacobian(after, point)
    step = ca.Function("step", [x, u, d, p, h], [after, by_point])
    state, *held = problem.nominal_point
    length = problem.sampling_time / model.time_unit

    def linear(substeps: int) -> Array:
        """A and B side by side."""
        present = state
        jacobian = np.eye(n, n + m)
        # The action is held: its own derivative stays (0, I).
        held_jacobian = np.eye(m, n + m, n)
        for _ in range(substeps):
            after_step, by_step = step(present, *held, length / substeps)
            present = after_step.full()
            slope = by_step.full()
            # The chain rule: what a step makes of the derivatives of its own start.
            of_start = np.vstack([jacobian, held_jacobian])
            jacobian = slope @ of_start
        return jacobian

    substeps = problem.substeps
    present = linear(substeps)
    while substeps <= 1024:
        # Doubling shows the error of the coarser one: that of the finer is a sixteenth.
        finer = linear(2 * substeps)
        allowed = 1e-8 * (1.0 + np.abs(present))
        change = np.abs(finer - present)
        if (change <= allowed).all():
            return substeps
        substeps = 2 * substeps
        present = finer
    raise TuningError(
        f"model '{problem.model.name}' cannot be integrated to 1e-08 over a sample of "
        f"{problem.sampling_time:g} s"
    )


def _rounded(block: Array, ranges: Array) -> Array:
    """Entries to six digits, 0 below 1e-9 of the largest, without a solver's last bits.

    Args:
        block: A vector (k,) or a matrix (k, k) in units of the problem.
        ranges: Of the variables, (k,): over them the entries are compared, so that no unit decides
            which are zero.
    """
    # The last bits are the solver's and differ between platforms; θ files must not.
    over_ranges = np.abs(block) * ranges
    if block.ndim == 2:
        over_ranges = over_ranges * ranges[:, None]
    least = 1e-9 * over_ranges.max(initial=0.0)
    rounded = np.zeros(block.shape)
    for place, x in np.ndenumerate(block):
        if over_ranges[place] > least:
            rounded[place] = float(f"{x:.6g}")
    return rounded


def _symmetric(matrix: NDArray[np.floating[Any]]) -> Array:
    """The symmetric part of a matrix that is symmetric but for rounding."""
    part = 0.5 * (matrix + matrix.T)
    return np.asarray(part, dtype=np.float64)


def _five_digits(array: NDArray[np.floating[Any]]) -> str:
    """Entries to five digits, on one line."""
    rows = []
    for row in array:
        if row.ndim:
            rows.append(_five_digits(row))
        else:
            rows.append(f"{float(row):.5g}")
    joined = ", ".join(rows)
    return f"[{joined}]"


def solve_conic(
    P: Array,
    q: Array,
    A: Array,
    b: Array,
    cones: Sequence[Any],
    *,
    iterations: int = 200,
) -> tuple[Array | None, str]:
    """Solve min ½xᵀPx + qᵀx s.t. b − Ax in the product of Clarabel's `cones`.

    Args:
        P: Hessian (d, d), of which the upper triangle is read.
        q: Gradient, (d,).
        A: Matrix of the constraints, (c, d).
        b: Their right-hand side, (c,).
        cones: Clarabel's cones of b − Ax, in the order of its rows. `PSDTriangleConeT`, of positive
            semidefinite matrices, takes the rows that `svec` gives.
        iterations: Most iterations.

    Returns:
        The minimiser (d,), None where there is none, and the solver's word for how it ended.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = iterations
    quadratic = sparse.csc_matrix(np.triu(P))
    constraints = sparse.csc_matrix(A)
    solver = clarabel.DefaultSolver(
        quadratic,
        q,
        constraints,
        b,
        list(cones),
        settings,
    )
    solution = solver.solve()
    status = str(solution.status)
    # Nearly solved is of use, too: whoever asks checks what is made of it.
    if status not in {"Solved", "AlmostSolved"}:
        return None, status
    return np.array(solution.x), status


def svec(matrix: Array) -> Array:
    """Vector of a symmetric matrix with its inner product: `svec_order` of its upper triangle."""
    dimension = len(matrix)
    order, weight = svec_order(dimension)
    packed: Array = matrix[np.triu_indices(dimension)]
    return weight * packed[order]


def svec_order(dimension: int) -> tuple[NDArray[np.intp], Array]:
    """Order and weights that make `svec` of an upper triangle packed row by row.

    Clarabel stacks the upper triangle column by column, off-diagonal entries times √2.
    """
    rows, columns = np.triu_indices(dimension)
    order = np.lexsort((rows, columns))
    # √2 makes the vectors' inner product that of the matrices.
    on_diagonal = rows == columns
    weight = np.where(on_diagonal, 1.0, np.sqrt(2.0))
    return order, weight[order]
