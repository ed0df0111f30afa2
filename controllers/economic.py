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

from controllers.errors import TuningError
from controllers.model import discretise, runge_kutta
from controllers.problem import Problem
from controllers.theta import Parameters, ThetaBlocks, symmetric_matrix
from cosim.core.protocols import Array

# A bound counts as strictly active above this share of the largest multiplier.
_STRICT = 1e-6


@dataclass(frozen=True)
class SteadyState:
    """Optimum of min ℓ(x, u) s.t. x = f(x, u) and the bounds, for the sampled nominal model.

    `x` (n,), `u` (m,), `cost` ℓ_s; `costate` λ (n,) of f(x, u) − x = 0; `multipliers` (n+m,) of the
    bounds of w = (x, u), positive at a lower and negative at an upper bound, are the gradient of
    ℓ + λᵀ(f − x); `A` (n, n), `B` (n, m) Jacobians of f; `hessian` H = ∇²_w (ℓ + λᵀf) (n+m, n+m);
    `C` (n_c, n+m) gradients of the strictly active bounds, `active` these in words.
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

    def __str__(self) -> str:
        return (
            f"optimal steady state: x = {_short(self.x)}, u = {_short(self.u)}, "
            f"cost {self.cost:.6g}, active: {', '.join(self.active) or 'no bound'}"
        )


def optimal_steady_state(problem: Problem) -> SteadyState:
    """Solve for the optimal steady state with IPOPT, started from the problem's reference.

    Raises TuningError where IPOPT fails, or where a state bound's multiplier exceeds the linear
    weight of the penalty, so that the relaxed problem would rather violate the bound.
    """
    model = problem.model
    n = problem.n_states
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", problem.n_actions)
    d, p = ca.DM(model.nominal_disturbance), ca.DM(model.nominal_parameters)
    x_next = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
    cost = model.economic_cost(x, u, ca.SX(d), ca.SX(p))
    w = ca.vertcat(x, u)
    options: dict[str, Any] = {
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11, "bound_relax_factor": 0.0},
        "print_time": False,
        "error_on_fail": False,
    }
    solver = ca.nlpsol("steady_state", "ipopt", {"x": w, "f": cost, "g": x_next - x}, options)
    lower, upper = problem.lower, problem.upper
    found = solver(x0=problem.reference, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
    stats = solver.stats()
    if not stats["success"]:
        raise TuningError(
            f"the optimal steady state of model '{model.name}' was not found (IPOPT: "
            f"{stats['return_status']}); check bounds, and the reference, which is its start"
        )
    point, costate = found["x"].full().reshape(-1), found["lam_g"].full().reshape(-1)
    lagrangian = cost + ca.dot(ca.SX(ca.DM(costate)), x_next - x)
    hessian, gradient = ca.hessian(lagrangian, w)
    derivatives = ca.Function("d", [w], [hessian, gradient, ca.jacobian(x_next, w)])
    hessian, gradient, jacobian = (value.full() for value in derivatives(point))
    multipliers = gradient.reshape(-1)
    strict = np.flatnonzero(np.abs(multipliers) > _STRICT * max(1.0, np.abs(multipliers).max()))
    active, quantities = [], (*model.states, *model.actions)
    for i in strict:
        quantity = quantities[i]
        if i < n and abs(multipliers[i]) >= problem.penalty_linear[i]:
            raise TuningError(
                f"the penalty of {quantity.name} is too small: its linear weight "
                f"{problem.penalty_linear[i]:g} must exceed the bound's multiplier "
                f"{abs(multipliers[i]):g}"
            )
        relation, bound = ("≥", lower[i]) if multipliers[i] > 0 else ("≤", upper[i])
        active.append(f"{quantity.name} {relation} {bound:g} {quantity.unit}".rstrip())
    return SteadyState(
        x=point[:n],
        u=point[n:],
        cost=float(found["f"]),
        costate=costate,
        multipliers=multipliers,
        A=jacobian[:, :n],
        B=jacobian[:, n:],
        hessian=hessian,
        C=np.eye(len(point))[strict],
        active=tuple(active),
    )


def local_feedback(A: Array, B: Array, H: Array, C: Array) -> tuple[Array, Array]:
    """Gain K (m, n) of u = Kx and value P (n, n) of min Σ ½ wᵀHw, w = (x, u), x₊ = Ax + Bu, γ = 1.

    It solves the Riccati equation on the manifold C w_k = 0, k ≥ 1, of the active constraints. A
    row of `C` (n_c, n+m) with an entry in u binds from k = 0 on, one of the state alone binds the
    next state. H (n+m, n+m) may be indefinite. Raises TuningError where the actions cannot keep the
    constraints, or no stabilising solution exists.
    """
    n, m = B.shape
    on_action = np.abs(C[:, n:]).max(axis=1, initial=0.0) > 0
    rows = np.vstack([C[on_action], C[~on_action, :n] @ np.hstack([A, B])])
    # Actions that keep the constraints: u = particular x + free v.
    gain, free = np.zeros((m, n)), np.eye(m)
    if len(rows):
        if np.linalg.matrix_rank(rows[:, n:]) < len(rows):
            raise TuningError(
                f"the {len(rows)} active constraints cannot all be kept by the {m} actions within "
                "one sample: local feedback is not defined by them"
            )
        gain = -np.linalg.pinv(rows[:, n:]) @ rows[:, :n]
        free = null_space(rows[:, n:])
    if free.shape[1]:
        # The Riccati equation of v.
        change = np.block([[np.eye(n), np.zeros((n, free.shape[1]))], [gain, free]])
        reduced, a, b = change.T @ H @ change, A + B @ gain, B @ free
        q, r, s = reduced[:n, :n], reduced[n:, n:], reduced[:n, n:]
        try:
            P = solve_discrete_are(a, b, q, r, s=s)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise TuningError(
                f"the steady state has no stabilising local feedback of finite cost ({error})"
            ) from error
        curvature = r + b.T @ P @ b
        if np.linalg.eigvalsh(_symmetric(curvature)).min() <= 0:
            raise TuningError("the steady state is no local minimum of the economic cost")
        gain = gain + free @ -np.linalg.solve(curvature, b.T @ P @ a + s.T)
    closed, stage = A + B @ gain, np.vstack([np.eye(n), gain])
    if np.abs(np.linalg.eigvals(closed)).max() >= 1:
        raise TuningError("the active constraints, once kept, make the closed loop unstable")
    # P = stage + closedᵀ P closed: the Riccati solver's P is accurate in the gain's part only.
    P = solve_discrete_lyapunov(closed.T, stage.T @ H @ stage, method="direct")
    return gain, _symmetric(P)


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


def rotation(A: Array, B: Array, delta_P: Array) -> Array:
    """𝓗(δP) = [A B]ᵀ δP [A B] − [I 0]ᵀ δP [I 0]: the storage ½xᵀδPx as a stage cost."""
    dynamics = np.hstack([A, B])
    rotated: Array = dynamics.T @ delta_P @ dynamics
    rotated[: len(A), : len(A)] -= delta_P
    return rotated


def convexify(A: Array, B: Array, H: Array, C: Array, weight: float = 1e-2) -> Convexification:
    """Best-conditioned convex stage cost with the same local optimum.

    min β + ρ‖F‖ s.t. βI ⪰ αH + 𝓗(δP) + CᵀFC ⪰ I over α ≥ 0, β, δP and F, with ρ = `weight`
    (Zanon, Gros, Diehl 2016). 𝓗(δP) telescopes along a trajectory and CᵀFC vanishes where C w = 0,
    so neither changes the optimal feedback. Raises TuningError where there is no solution: the
    steady state is not locally optimal under these constraints.
    """
    size, n, n_c = len(H), len(A), len(C)
    rotations = [rotation(A, B, e) for e in _symmetric_basis(n)]
    forces = [C.T @ e @ C for e in _symmetric_basis(n_c)]
    columns = np.stack([svec(matrix) for matrix in (H, *rotations, *forces)], axis=1)
    count, triangle = columns.shape[1], columns.shape[0]
    identity = svec(np.eye(size))[:, None]
    # Variables: α, δP, F, β, t with t ≥ ‖F‖.
    n_F = n_c * (n_c + 1) // 2
    zeros = np.zeros((triangle, 1))
    nonnegative, norm = np.zeros((1, count + 2)), np.zeros((1 + n_F, count + 2))
    nonnegative[0, 0] = norm[0, -1] = -1.0
    norm[1:, count - n_F : count] = -np.diag([np.linalg.norm(e) for e in _symmetric_basis(n_c)])
    above, below = np.hstack([-columns, zeros, zeros]), np.hstack([columns, -identity, zeros])
    constraints = np.vstack([nonnegative, norm, above, below])
    offset = np.concatenate([np.zeros(2 + n_F), -identity[:, 0], np.zeros(triangle)])
    cones = [
        clarabel.NonnegativeConeT(1),
        clarabel.SecondOrderConeT(1 + n_F),
        *2 * [clarabel.PSDTriangleConeT(size)],
    ]
    objective = np.zeros(count + 2)
    objective[-2:] = 1.0, weight
    z, status = solve_conic(
        np.zeros((count + 2, count + 2)), objective, constraints, offset, cones, iterations=500
    )
    if z is None or not z[0] > 0:
        raise TuningError(
            f"no convex cost has the local optimum of the economic one with {n_c} active "
            f"constraint{'' if n_c == 1 else 's'} (Clarabel: {status}): staying at the "
            "steady state is not optimal"
        )
    alpha = float(z[0])
    delta_P = symmetric_matrix(z[1 : count - n_F], n) / alpha
    F = symmetric_matrix(z[count - n_F : count], n_c) / alpha
    hessian = H + rotation(A, B, delta_P) + C.T @ F @ C
    found = Convexification(_symmetric(hessian), delta_P, F, alpha, float(z[-2]))
    if not (least := np.linalg.eigvalsh(found.hessian)[0]) > 0:
        raise TuningError(
            f"the convexified cost is not positive definite (smallest eigenvalue {least:.3g}, "
            f"Clarabel: {status})"
        )
    return found


def _symmetric_basis(size: int) -> list[Array]:
    """Basis of the symmetric matrices: e_ij + e_ji, upper triangle row by row."""
    return [symmetric_matrix(unit, size) for unit in np.eye(size * (size + 1) // 2)]


@dataclass(frozen=True)
class EconomicTuning:
    """Tuned θ with its certificate.

    `economic` is the local feedback gain (m, n) of the economic cost itself (γ = 1, active
    constraints kept), `tuned` that of the convexified one.
    """

    parameters: Parameters
    steady_state: SteadyState
    convexification: Convexification
    economic: Array
    tuned: Array

    @property
    def gain_error(self) -> float:
        """Largest difference between the tuned local feedback gain and the economic one."""
        return float(np.abs(self.tuned - self.economic).max())

    def __str__(self) -> str:
        steady, convex = self.steady_state, self.convexification
        active = ", ".join(
            f"{name} (multiplier {multiplier:.4g})"
            for name, multiplier in zip(steady.active, steady.C @ steady.multipliers, strict=True)
        )
        return "\n".join(
            [
                f"optimal steady state  x = {_short(steady.x)}, u = {_short(steady.u)}, "
                f"cost {steady.cost:.6g}",
                f"strictly active       {active or 'none'}",
                f"economic Hessian      eigenvalues {_short(np.linalg.eigvalsh(steady.hessian))}",
                f"convexified Hessian   eigenvalues {_short(np.linalg.eigvalsh(convex.hessian))}, "
                f"α = {convex.alpha:.4g}, β = {convex.beta:.4g}, F = {_short(convex.F)}",
                f"economic gain         {_short(self.economic)}",
                f"tuned gain            differs by {self.gain_error:.2g}",
            ]
        )


def tune(problem: Problem, blocks: ThetaBlocks | None = None) -> EconomicTuning:
    """Tune the NMPC: its local feedback becomes the economic optimum's (docs/method.md).

    ℓ_θ = ½ΔwᵀMΔw + qᵀΔw with M = H̃ + (1−γ)[A B]ᵀP[A B] and V^f_θ = ½ΔxᵀPΔx + q_xᵀΔx: H̃ is the
    convexified Hessian, q the gradient along the active constraints, P the value of H̃ under γ = 1.
    λ_θ undoes the rotations by costate and storage, so that V_θ is to second order the economic
    value; c_λ is ℓ_s. θ is rounded to six digits. Raises TuningError where steady state, local
    optimum or convexification do not exist.
    """
    steady = optimal_steady_state(
        dataclasses.replace(problem, substeps=linearisation_substeps(problem))
    )
    n, A, B = problem.n_states, steady.A, steady.B
    try:
        economic, _ = local_feedback(A, B, steady.hessian, steady.C)
        convex = convexify(A, B, steady.hessian, steady.C, 1e-3)
        tuned, P = local_feedback(A, B, convex.hessian, steady.C)
    except TuningError as error:
        raise TuningError(
            f"{error}. {steady}. Change the bounds so that the cost has a minimum with other "
            "bounds active, or the model's economic cost so that it has one inside them"
        ) from error
    dynamics = np.hstack([A, B])
    M = convex.hessian + (1.0 - problem.discount) * dynamics.T @ P @ dynamics
    q, C_x = steady.multipliers, steady.C[:, :n]
    # θ's quadratics are about the reference, the tuning's about the optimal steady state.
    shift = problem.reference - np.concatenate([steady.x, steady.u])
    initial = convex.delta_P - C_x.T @ convex.F @ C_x
    values = {
        "B_l": _symmetric(0.5 * M),
        "b_l": q + M @ shift,
        "B_Vf": _symmetric(0.5 * P),
        "b_Vf": q[:n] + P @ shift[:n],
        "B_lambda": _symmetric(0.5 * initial),
        "b_lambda": steady.costate + initial @ shift[:n],
    }
    parameters = Parameters.naive(problem, blocks).replace(
        {name: _rounded(value) for name, value in values.items()}
    )
    return EconomicTuning(parameters, steady, convex, economic, tuned)


def linearisation_substeps(problem: Problem) -> int:
    """Runge–Kutta steps a sample with a relative error below 1e-8, at the reference.

    The error is that of A and B. The problem's own number is doubled until doubling it once more
    changes less. Raises TuningError where 1024 steps are too few.
    """
    model, (x, u, d, p), h = problem.model, problem.model.symbols(), ca.SX.sym("h")
    after = runge_kutta(lambda at: model.ode(at, u, d, p), x, h, 1)
    step = ca.Function("step", [x, u, d, p, h], [after, ca.jacobian(after, ca.vertcat(x, u))])
    given = problem.reference_action, model.nominal_disturbance, model.nominal_parameters
    length, n, m = problem.sampling_time / model.time_unit, problem.n_states, problem.n_actions

    def linear(substeps: int) -> Array:
        """A and B side by side."""
        at, moved = problem.reference_state, np.eye(n, n + m)
        for _ in range(substeps):
            at, slope = (part.full() for part in step(at, *given, length / substeps))
            moved = slope @ np.vstack([moved, np.eye(m, n + m, n)])
        return moved

    substeps, present = problem.substeps, linear(problem.substeps)
    while substeps <= 1024:
        finer = linear(2 * substeps)
        if (np.abs(finer - present) <= 1e-8 * (1.0 + np.abs(present))).all():
            return substeps
        substeps, present = 2 * substeps, finer
    raise TuningError(
        f"model '{problem.model.name}' cannot be integrated to 1e-08 over a sample of "
        f"{problem.sampling_time:g} s"
    )


def linear_model(problem: Problem) -> tuple[Array, Array]:
    """A (n, n) and B (n, m) of the sampled nominal model at the problem's reference."""
    model, (x, u, d, p) = problem.model, problem.model.symbols()
    following = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
    jacobian = ca.Function("AB", [x, u, d, p], [ca.jacobian(following, ca.vertcat(x, u))])
    at = (problem.reference_state, problem.reference_action)
    both = jacobian(*at, model.nominal_disturbance, model.nominal_parameters).full()
    return both[:, : problem.n_states], both[:, problem.n_states :]


def _rounded(block: Array) -> Array:
    """Entries to six digits, 0 below 1e-9 of the largest, without a solver's last bits."""
    least = 1e-9 * float(np.abs(block).max(initial=0.0))
    kept = [float(f"{x:.6g}") if abs(x) > least else 0.0 for x in block.flat]
    return np.array(kept).reshape(block.shape)


def _symmetric(matrix: NDArray[np.floating[Any]]) -> Array:
    return np.asarray(0.5 * (matrix + matrix.T), dtype=np.float64)


def _short(array: NDArray[np.floating[Any]]) -> str:
    """Entries to five digits, on one line."""
    rows = [_short(row) if row.ndim else f"{float(row):.5g}" for row in array]
    return f"[{', '.join(rows)}]"


def solve_conic(
    P: Array, q: Array, A: Array, b: Array, cones: Sequence[Any], *, iterations: int = 200
) -> tuple[Array | None, str]:
    """Solve min ½xᵀPx + qᵀx s.t. b − Ax in the product of Clarabel's `cones`.

    P (d, d), of which the upper triangle is read, q (d,), A (c, d), b (c,). `PSDTriangleConeT`, of
    positive semidefinite matrices, takes the rows that `svec` gives. Returns the minimiser, None
    where there is none, and the solver's word for how it ended.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = iterations
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(P)), q, sparse.csc_matrix(A), b, list(cones), settings
    ).solve()
    status = str(solution.status)
    return np.array(solution.x) if status in {"Solved", "AlmostSolved"} else None, status


def svec(matrix: Array) -> Array:
    """Vector of a symmetric matrix with its inner product: `svec_order` of its upper triangle."""
    order, weight = svec_order(len(matrix))
    packed: Array = matrix[np.triu_indices(len(matrix))]
    return weight * packed[order]


def svec_order(dimension: int) -> tuple[NDArray[np.intp], Array]:
    """Order and weights that make `svec` of an upper triangle packed row by row.

    Clarabel stacks the upper triangle column by column, off-diagonal entries times √2.
    """
    rows, columns = np.triu_indices(dimension)
    order = np.lexsort((rows, columns))
    return order, np.where(rows == columns, 1.0, np.sqrt(2.0))[order]
