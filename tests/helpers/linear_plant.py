"""Linear plants with quadratic cost, whose optimum the Riccati equation gives."""

import casadi as ca
import numpy as np
import scipy.linalg

from controllers import Model, Problem, Quantity
from controllers.problem import DisturbanceLaw, PlantProblem


class LinearPlant:
    """x' = Fx + Gu + Ed with d ~ N(0, diag σ²) held over samples of one second, ℓ = xᵀQx + uᵀRu.

    Sampled by SciPy's matrix exponential, independently of the package's integrator.
    """

    def __init__(self, F, G, E, Q, R, sigma, bound=3.0, discount=0.9):
        F, G, E, Q, R = (np.atleast_2d(np.array(M, dtype=float)) for M in (F, G, E, Q, R))
        n, m, p = len(F), G.shape[1], E.shape[1]
        self.Q, self.R, self.discount = Q, R, discount
        block = np.zeros((n + m + p, n + m + p))
        block[:n] = np.hstack([F, G, E])
        sampled = scipy.linalg.expm(block)[:n]
        self.A, self.B, self.E = sampled[:, :n], sampled[:, n : n + m], sampled[:, n + m :]
        self.covariance = self.E @ np.diag(np.square(sigma)) @ self.E.T
        model = Model(
            name="linear",
            states=tuple(Quantity(f"x{i}", "1") for i in range(n)),
            actions=tuple(Quantity(f"u{i}", "1") for i in range(m)),
            disturbances=tuple(Quantity(f"d{i}", "1") for i in range(p)),
            parameters=(Quantity("one", "1", 1.0),),
            ode=lambda x, u, d, p: p[0] * (ca.DM(F) @ x + ca.DM(G) @ u + ca.DM(E) @ d),
            economic_cost=lambda x, u, d, p: ca.bilin(ca.DM(Q), x) + ca.bilin(ca.DM(R), u),
        )
        self.problem = Problem(
            model=model,
            sampling_time=1.0,
            horizon=1,
            discount=discount,
            state_lower=-bound * np.ones(n),
            state_upper=bound * np.ones(n),
            action_lower=-bound * np.ones(m),
            action_upper=bound * np.ones(m),
            penalty_linear=np.ones(n),
            penalty_quadratic=np.ones(n),
            reference_state=np.zeros(n),
            reference_action=np.zeros(m),
            reference_cost=0.0,
        )
        law = DisturbanceLaw("normal", np.zeros(p), np.array(sigma, dtype=float))
        self.plant = PlantProblem(self.problem, law, np.ones(1))

    def riccati(self, discount=1.0):
        """Value matrix P and gain K of u = Kx for a discount."""
        root = np.sqrt(discount)
        P = scipy.linalg.solve_discrete_are(root * self.A, root * self.B, self.Q, self.R)
        S = self.R + discount * self.B.T @ P @ self.B
        return P, -np.linalg.solve(S, discount * self.B.T @ P @ self.A)

    def mean_cost(self, K):
        """Stationary mean cost of u = Kx, from its Lyapunov equation."""
        covariance = scipy.linalg.solve_discrete_lyapunov(self.A + self.B @ K, self.covariance)
        return float(np.trace((self.Q + K.T @ self.R @ K) @ covariance))


SCALAR = LinearPlant(F=[[0.1]], G=[[0.8]], E=[[1.0]], Q=[[1.0]], R=[[0.5]], sigma=[0.1])
PLANE = LinearPlant(
    F=[[0.0, 1.0], [-0.3, -0.4]],
    G=[[0.0], [0.9]],
    E=[[0.5, 0.0], [0.0, 1.0]],
    Q=np.diag([1.0, 0.3]),
    R=[[0.4]],
    sigma=[0.1, 0.1],
)
