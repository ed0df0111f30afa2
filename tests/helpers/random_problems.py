"""Random problems in any units, and an independent solver of their QP: stage by stage, in NumPy."""

from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import clarabel
import numpy as np
import scipy.sparse as sp

from controllers import LinearisationPoint, Parameters, Problem, ThetaBlocks
from controllers.model import Model, Quantity

SUBSTEPS = 2


@dataclass(frozen=True)
class Case:
    """A random problem by numbers that say all of it; units of states, actions and cost in decades.

    `growth` is the real part of the fastest mode times the sampling time, `bent` the size of the
    model's quadratic term, `tight` that of the actuators' range, `far` how far outside its bounds
    the state may be.
    """

    seed: int
    n: int = 2
    m: int = 1
    horizon: int = 5
    growth: float = -0.3
    bent: float = 0.1
    tight: float = 1.0
    far: float = 0.3
    discount: float = 0.97
    decades: tuple[float, ...] = ()
    cost_decade: float = 0.0

    def units(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Units of states (n,), actions (m,) and cost, as multiples of those of size one."""
        decades = np.zeros(self.n + self.m)
        decades[: len(self.decades)] = self.decades[: decades.size]
        units = 10.0**decades
        return units[: self.n], units[self.n :], 10.0**self.cost_decade


@dataclass(frozen=True)
class Drawn:
    """What a case's seed draws, all in units of size one."""

    case: Case
    A: np.ndarray = field(init=False)
    B: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        case, rng = self.case, np.random.default_rng(self.case.seed)
        n, m, N = case.n, case.m, case.horizon
        A = rng.normal(size=(n, n)) / np.sqrt(n)
        A += (case.growth - np.linalg.eigvals(A).real.max()) * np.eye(n)
        values = {
            "A": A,
            "B": rng.normal(size=(n, m)),
            "bend": case.bent * rng.normal(size=n),
            "x": 0.3 * rng.normal(size=(N, n)),
            "u": 0.3 * case.tight * rng.normal(size=(N, m)),
            "costates": rng.normal(size=(N, n)),
            "x_lower": -1 + 0.3 * rng.normal(size=n),
            "x_upper": 1.5 + 0.3 * rng.random(n),
            "s": rng.uniform(-0.5 - case.far, 0.5 + case.far, n),
            "a": case.tight * rng.uniform(-1, 1, m),
            "w": 10 ** rng.uniform(0.5, 3, n),
            "W": 10 ** rng.uniform(0, 2, n),
            "direction": rng.normal(size=1000),
            "theta": _theta(rng, n, m),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def rate(self, x, u, p):
        """dx/dt times the sampling time, of arrays or CasADi's symbols: sin is the one bend."""
        n = self.case.n
        linear = [sum(self.A[i, j] * x[j] for j in range(n)) for i in range(n)]
        driven = [sum(self.B[i, j] * u[j] for j in range(self.case.m)) for i in range(n)]
        return [p * linear[i] + driven[i] + self.bend[i] * x[i] * x[(i + 1) % n] for i in range(n)]

    def step(self, x, u, p):
        """State after one sample, by Runge and Kutta's fourth-order method."""
        h = 1.0 / SUBSTEPS
        for _ in range(SUBSTEPS):
            k1 = np.array(self.rate(x, u, p))
            k2 = np.array(self.rate(x + h / 2 * k1, u, p))
            k3 = np.array(self.rate(x + h / 2 * k2, u, p))
            k4 = np.array(self.rate(x + h * k3, u, p))
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    def jacobian(self, x, u, p):
        """f and its Jacobian in (x, u), by complex steps."""
        n, size = self.case.n, self.case.n + self.case.m
        w, columns = np.concatenate([x, u]).astype(complex), []
        for j in range(size):
            moved = w.copy()
            moved[j] += 1e-30j
            columns.append(self.step(moved[:n], moved[n:], p).imag / 1e-30)
        return self.step(x, u, p), np.array(columns).T

    def curvature(self, x, u, p, chi):
        """∇² of χᵀf in (x, u): differences of the complex steps, extrapolated."""
        n, w = self.case.n, np.concatenate([x, u])

        def gradient(w):
            return chi @ self.jacobian(w[:n], w[n:], p)[1]

        def difference(h):
            steps = h * np.eye(w.size)
            return np.array([(gradient(w + e) - gradient(w - e)) / (2 * h) for e in steps])

        found = (4 * difference(1e-3) - difference(2e-3)) / 3
        return (found + found.T) / 2


def _theta(rng, n, m):
    def definite(size):
        root = rng.normal(size=(size, size))
        return root @ root.T / size + 0.1 * np.eye(size)

    return {
        "B_lambda": definite(n),
        "b_lambda": rng.normal(size=n),
        "c_lambda": rng.normal(size=1),
        "B_Vf": definite(n),
        "b_Vf": 0.3 * rng.normal(size=n),
        "B_l": definite(n + m),
        "b_l": 0.5 * rng.normal(size=n + m),
        "c_f": 0.05 * rng.normal(size=n),
    }


class InUnits:
    """The problem of a case as the package has it, in the case's units."""

    def __init__(self, case: Case) -> None:
        self.case, self.drawn = case, Drawn(case)
        drawn, (x, u, cost) = self.drawn, case.units()
        self.state, self.action, self.cost = x, u, cost

        def ode(s, a, d, p):
            rate = drawn.rate(_over(s, x), _over(a, u), p[0])
            return ca.vertcat(*(float(x[i]) * rate[i] for i in range(case.n)))

        def economic_cost(s, a, d, p):
            size, effort = _over(s, x), _over(a, u)
            return cost * (1 + sum(z * z for z in size) + 0.1 * sum(z * z for z in effort))

        model = Model(
            "random",
            tuple(Quantity(f"x{i}", "-") for i in range(case.n)),
            tuple(Quantity(f"u{i}", "-") for i in range(case.m)),
            (),
            (Quantity("k", "-", 1.0),),
            ode,
            economic_cost,
        )
        one = np.ones(case.m)
        self.problem = Problem(
            model=model, sampling_time=1.0, horizon=case.horizon, discount=case.discount,
            state_lower=x * drawn.x_lower, state_upper=x * drawn.x_upper,
            action_lower=-u * case.tight * one, action_upper=u * case.tight * one,
            penalty_linear=cost * drawn.w / x, penalty_quadratic=cost * drawn.W / x**2,
            reference_state=np.zeros(case.n), reference_action=np.zeros(case.m),
            reference_cost=cost, substeps=SUBSTEPS,
        )  # fmt: skip
        self.blocks = ThetaBlocks.from_problem(
            self.problem, slack_weights=True, model_parameters=("k",)
        )

    @cached_property
    def factors(self) -> np.ndarray:
        """Of each entry of θ, its value in the case's units over that in units of size one."""
        x, u, cost = self.state, self.action, self.cost
        both = np.concatenate([x, u])

        def quadratic(units):
            return (cost / np.outer(units, units))[np.triu_indices(units.size)]

        by_name = {
            "B_lambda": quadratic(x), "b_lambda": cost / x, "c_lambda": [cost],
            "B_Vf": quadratic(x), "b_Vf": cost / x, "B_l": quadratic(both), "b_l": cost / both,
            "c_f": x, "x_l": x, "x_u": x, "w_sigma": cost / x, "W_sigma": cost / x**2, "p": [1.0],
        }  # fmt: skip
        return np.concatenate([by_name[block.name] for block in self.blocks])

    @cached_property
    def theta(self) -> np.ndarray:
        """θ in units of size one."""
        drawn, blocks = self.drawn, self.blocks
        values = drawn.theta | {
            "x_l": drawn.x_lower, "x_u": drawn.x_upper, "w_sigma": drawn.w, "W_sigma": drawn.W,
            "p": [1.0],
        }  # fmt: skip
        parts = []
        for block in blocks:
            value = np.asarray(values[block.name], dtype=float)
            parts.append(value[np.triu_indices(len(value))] if block.symmetric else value)
        return np.concatenate(parts)

    def parameters(self, theta: np.ndarray) -> Parameters:
        """θ, given in units of size one, in the case's."""
        return Parameters(self.blocks, theta * self.factors)

    @property
    def point(self) -> LinearisationPoint:
        """The drawn point of linearisation in the case's units."""
        drawn = self.drawn
        price = self.cost / self.state
        return LinearisationPoint(
            drawn.x * self.state, drawn.u * self.action, drawn.costates * price
        )


def _over(vector, units):
    return [vector[i] / float(units[i]) for i in range(len(units))]


@dataclass(frozen=True)
class Answer:
    """A solution in units of size one: the value, the first action, the residual of the KKT system,

    and how far the nearest limit is from changing its activity.
    """

    value: float
    action: np.ndarray
    residual: float
    margin: float
    active: bytes


class Oracle:
    """V or Q of a case's QP from its stages, in units of size one; nothing is condensed.

    The QP in (ξ_1, v_0, …, ξ_N, v_{N−1}, t) goes to Clarabel; the active set of its solution to one
    sparse KKT system.
    """

    def __init__(self, given: InUnits, hessian: str) -> None:
        self._given, self._hessian = given, hessian
        self._blocks = given.blocks

    def blocks_of(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        found = {}
        for block in self._blocks:
            part = theta[self._blocks.slices[block.name]]
            if block.symmetric:
                size = block.shape[0]
                matrix = np.zeros((size, size))
                matrix[np.triu_indices(size)] = part
                part = matrix + matrix.T - np.diag(matrix.diagonal())
            found[block.name] = part
        return found

    def stages(self, theta: np.ndarray):
        """(A, B, r, L, q, constant) by stage at the drawn point."""
        given, drawn, case = self._given, self._given.drawn, self._given.case
        block, n = self.blocks_of(theta), self._given.case.n
        scale = given.problem.scale
        units = np.concatenate([given.state, given.action])
        metric = np.outer(scale.ranges / units, scale.ranges / units) / (scale.level / given.cost)
        stages = []
        for k in range(case.horizon):
            x, u, p = drawn.x[k], drawn.u[k], float(block["p"][0])
            f, J = drawn.jacobian(x, u, p)
            A, B = J[:, :n], J[:, n:]
            r = f - A @ x - B @ u + block["c_f"]
            L = 2 * case.discount**k * block["B_l"]
            q, constant = case.discount**k * block["b_l"], 0.0
            if self._hessian == "exact":
                at = np.concatenate([x, u])
                full = L + drawn.curvature(x, u, p, drawn.costates[k])
                values, vectors = np.linalg.eigh(full * metric)
                lifted = np.maximum(values, 1e-3 * case.discount**k)
                full = (vectors * lifted) @ vectors.T / metric
                q = q + (L - full) @ at
                constant = 0.5 * at @ (full - L) @ at
                L = full
            stages.append((A, B, r, L, q, constant))
        return stages

    def solve(  # noqa: PLR0915
        self, theta: np.ndarray, s: np.ndarray, a: np.ndarray | None = None
    ) -> Answer:
        """V(s), or Q(s, a)."""
        drawn, case = self._given.drawn, self._given.case
        block, n, m, N = self.blocks_of(theta), case.n, case.m, case.horizon
        gamma, width = case.discount, case.n + case.m
        stages = self.stages(theta)
        # z = (v_0, ξ_1, v_1, …, v_{N−1}, ξ_N, t_1, …, t_N)
        size = N * width + N * n
        P, c = np.zeros((size, size)), np.zeros(size)
        value = s @ block["B_lambda"] @ s + block["b_lambda"] @ s + block["c_lambda"][0]
        outside = np.maximum(np.maximum(drawn.x_lower - s, s - drawn.x_upper), 0)
        value += drawn.w @ outside + drawn.W @ outside**2
        E, e = np.zeros((N * n, size)), np.zeros(N * n)

        def v_at(k):
            return slice(k * width, k * width + m)

        def x_at(k):
            return slice((k - 1) * width + m, k * width)

        def t_at(k):
            return slice(N * width + (k - 1) * n, N * width + k * n)

        for k, (A, B, r, L, q, constant) in enumerate(stages):
            value += constant
            P[v_at(k), v_at(k)] = L[n:, n:]
            c[v_at(k)] += q[n:]
            row = slice(k * n, (k + 1) * n)
            E[row, x_at(k + 1)] = np.eye(n)
            E[row, v_at(k)] = -B
            e[row] = r
            if k:
                P[x_at(k), x_at(k)] = L[:n, :n]
                P[x_at(k), v_at(k)] = L[:n, n:]
                P[v_at(k), x_at(k)] = L[n:, :n]
                c[x_at(k)] += q[:n]
                E[row, x_at(k)] = -A
            else:
                value += 0.5 * s @ L[:n, :n] @ s + q[:n] @ s
                c[v_at(0)] += L[n:, :n] @ s
                e[row] += A @ s
            P[t_at(k + 1), t_at(k + 1)] = np.diag(2 * gamma ** (k + 1) * block["W_sigma"])
            c[t_at(k + 1)] = gamma ** (k + 1) * block["w_sigma"]
        P[x_at(N), x_at(N)] = 2 * gamma**N * block["B_Vf"]
        c[x_at(N)] += gamma**N * block["b_Vf"]
        lower, upper = np.full(N * m, -case.tight), np.full(N * m, case.tight)
        # Rows of G z ≤ h: actions, states, slack.
        G, h = [], []
        for k in range(N):
            unit_v, unit_x = (np.zeros((rows, size)) for rows in (m, n))
            unit_t = np.zeros((n, size))
            unit_v[:, v_at(k)], unit_x[:, x_at(k + 1)] = np.eye(m), np.eye(n)
            unit_t[:, t_at(k + 1)] = np.eye(n)
            if k or a is None:
                G += [unit_v, -unit_v]
                h += [upper[:m], -lower[:m]]
            G += [unit_x - unit_t, -unit_x - unit_t, -unit_t]
            h += [block["x_u"], -block["x_l"], np.zeros(n)]
        if a is not None:
            fixed = np.zeros((m, size))
            fixed[:, v_at(0)] = np.eye(m)
            E, e = np.vstack([E, fixed]), np.concatenate([e, a])
        P, E, G = (sp.csc_matrix(matrix) for matrix in (P, E, np.vstack(G)))
        h = np.concatenate(h)
        z, y, mu = _clarabel(P, c, E, e, G, h)
        z, y, mu, residual, margin = _newton(P, c, E, e, G, h, z, y, mu)
        value += 0.5 * z @ (P @ z) + c @ z
        return Answer(float(value), z[:m], residual, margin, (mu > 0).tobytes())


def _clarabel(P, c, E, e, G, h):
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    cones = [clarabel.ZeroConeT(len(e)), clarabel.NonnegativeConeT(len(h))]
    stacked = sp.csc_matrix(sp.vstack([E, G]))
    solver = clarabel.DefaultSolver(
        sp.csc_matrix(sp.triu(P)), c, stacked, np.concatenate([e, h]), cones, settings
    )
    found = solver.solve()
    duals = np.array(found.z)
    return np.array(found.x), duals[: len(e)], duals[len(e) :]


def _newton(P, c, E, e, G, h, z, y, mu):
    """The KKT system of the active set, until it stays; with its residual and its margin."""
    from scipy.sparse.linalg import splu

    best = None
    for _ in range(12):
        active = mu > h - G @ z
        C = sp.vstack([E, G[active]]).tocsc()
        kkt = sp.bmat([[P, C.T], [C, -1e-13 * sp.eye(C.shape[0])]]).tocsc()
        right = np.concatenate([-c, e, h[active]])
        try:
            factors = splu(kkt)
        except RuntimeError:
            break
        found = np.zeros(right.size)
        for _ in range(4):
            defect = right - sp.bmat([[P, C.T], [C, None]]) @ found
            found = found + factors.solve(defect)
        z, y = found[: z.size], found[z.size : z.size + len(e)]
        mu = np.zeros(len(h))
        mu[active] = found[z.size + len(e) :]
        slack = h - G @ z
        terms = np.abs(P @ z) + np.abs(c) + np.abs(E.T @ y) + np.abs(G.T @ mu)
        stationarity = np.abs(P @ z + c + E.T @ y + G.T @ mu) / (1 + terms.max())
        size = 1 + np.abs(mu).max()
        residual = max(
            stationarity.max(), np.abs(E @ z - e).max(), -slack.min(), -mu.min() / size, 0.0
        )
        margin = float(np.maximum(np.abs(slack), np.abs(mu) / size).min())
        if best is None or residual < best[3]:
            best = z, y, mu, float(residual), margin
        if residual < 1e-11:
            break
    return best if best is not None else (z, y, mu, np.inf, 0.0)
