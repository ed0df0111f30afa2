"""The nonlinear programme whose QP the RTI solves: for globalisation and for IPOPT as oracle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.buffered import StackedFunction, stacked
from controllers.dynamics import sampled_jacobian
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.theta import SymbolicTheta, ThetaBlocks

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Nlp:
    """Symbols and expressions of paper.tex eq. param_nmpc with x_0 = s put in.

    x (n, N) are the states x_1 … x_N in absolute units, u (m, N) the controls; `cost` is all but
    the penalty of the predicted states; `defects` (n, N) are f_θ(x_k, u_k) − x_{k+1}; `outside`
    (n, N) is max(x_l − x_k, x_k − x_u), whose positive part is the least slack.
    """

    s: ca.SX
    x: ca.SX
    u: ca.SX
    symbols: SymbolicTheta
    cost: ca.SX
    defects: ca.SX
    problem: Problem

    @classmethod
    def of(cls, problem: Problem, blocks: ThetaBlocks) -> Nlp:
        """Write the programme for a problem and the blocks of θ."""
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        symbols = SymbolicTheta.of(problem, blocks)
        s = ca.SX.sym("s", n)
        x, u = ca.SX.sym("x", n, horizon), ca.SX.sym("u", m, horizon)
        x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
        states = ca.horzcat(s, x)
        violation = ca.fmax(ca.fmax(problem.state_lower - s, s - problem.state_upper), 0)
        cost = ca.dot(problem.penalty_linear, violation)
        cost += ca.dot(problem.penalty_quadratic, violation**2) + symbols["c_lambda"]
        cost += ca.bilin(symbols["B_lambda"], s - x_s) + ca.dot(symbols["b_lambda"], s - x_s)
        defects = []
        for k in range(horizon):
            w = ca.vertcat(states[:, k] - x_s, u[:, k] - u_s)
            stage = ca.bilin(symbols["B_l"], w) + ca.dot(symbols["b_l"], w)
            cost += problem.discount**k * stage
            x_next, _ = sampled_jacobian(problem, states[:, k], u[:, k], symbols.model_parameters)
            defects.append(x_next + symbols["c_f"] - states[:, k + 1])
        end = states[:, horizon] - x_s
        terminal = ca.bilin(symbols["B_Vf"], end) + ca.dot(symbols["b_Vf"], end)
        cost += problem.discount**horizon * terminal
        return cls(s, x, u, symbols, cost, ca.horzcat(*defects), problem)

    def penalty_of(self, slack: ca.SX) -> ca.SX:
        """Discounted penalty of the slack (n, N) of stages 1 … N."""
        total = ca.SX(0)
        for k in range(self.problem.horizon):
            weight = self.problem.discount ** (k + 1)
            total += weight * ca.dot(self.symbols["w_sigma"], slack[:, k])
            total += weight * ca.dot(self.symbols["W_sigma"], slack[:, k] ** 2)
        return total

    @property
    def outside(self) -> ca.SX:
        """Distance of each predicted state beyond its learned bounds, negative inside."""
        count = self.problem.horizon
        lower = ca.repmat(self.symbols["x_l"], 1, count)
        upper = ca.repmat(self.symbols["x_u"], 1, count)
        return ca.fmax(lower - self.x, self.x - upper)


def merit(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """Cost, its gradient, penalty and defects at a point, for an ℓ1 merit function.

    Inputs s, x, u, theta; results `cost`, `gradient` (N(n+m), states first), `penalty` and
    `infeasibility` ‖defects‖₁.
    """
    nlp = Nlp.of(problem, blocks)
    return stacked(
        "merit",
        {"s": nlp.s, "x": nlp.x, "u": nlp.u, "theta": nlp.symbols.theta},
        {
            "gradient": ca.gradient(nlp.cost, ca.veccat(nlp.x, nlp.u)),
            "cost": nlp.cost,
            "penalty": nlp.penalty_of(ca.fmax(nlp.outside, 0)),
            "infeasibility": ca.sum1(ca.fabs(ca.vec(nlp.defects))),
        },
    )


@dataclass(frozen=True)
class IpoptSolution:
    """What IPOPT found: value, action (m,), states (N+1, n), controls (N, m), success."""

    value: float
    action: Vector
    states: Vector
    controls: Vector
    success: bool


class IpoptNmpc:
    """The same programme solved by IPOPT with explicit slack: an independent implementation."""

    def __init__(
        self, problem: Problem, blocks: ThetaBlocks, options: Mapping[str, Any] | None = None
    ) -> None:
        """Build the solver; `options` are CasADi's, added to silent defaults of tolerance 1e-10."""
        nlp = Nlp.of(problem, blocks)
        slack = ca.SX.sym("slack", problem.n_states, problem.horizon)
        z = ca.veccat(nlp.x, nlp.u, slack)
        lower = ca.repmat(nlp.symbols["x_l"], 1, problem.horizon) - nlp.x - slack
        upper = nlp.x - ca.repmat(nlp.symbols["x_u"], 1, problem.horizon) - slack
        defaults: dict[str, Any] = {
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "print_time": False,
            "ipopt.tol": 1e-10,
            "ipopt.bound_relax_factor": 0.0,
        }
        self._problem = problem
        self._solver = ca.nlpsol(
            "nmpc",
            "ipopt",
            {
                "x": z,
                "p": ca.veccat(nlp.s, nlp.symbols.theta),
                "f": nlp.cost + nlp.penalty_of(slack),
                "g": ca.veccat(nlp.defects, lower, upper),
            },
            defaults | dict(options or {}),
        )

    def solve(
        self,
        parameters: Parameters,
        s: ArrayLike,
        a: ArrayLike | None = None,
        guess: tuple[Vector, Vector] | None = None,
    ) -> IpoptSolution:
        """V(s) and π(s), or Q(s, a); `guess` is (states (N, n), controls (N, m))."""
        problem = self._problem
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        s = np.asarray(s, dtype=np.float64)
        states, controls = guess or (
            np.tile(problem.reference_state, (horizon, 1)),
            np.tile(problem.reference_action, (horizon, 1)),
        )
        low = np.tile(problem.action_lower, horizon)
        high = np.tile(problem.action_upper, horizon)
        if a is not None:
            low[:m] = high[:m] = a
        free = np.full(n * horizon, np.inf)
        outside = np.maximum(parameters["x_l"] - states, states - parameters["x_u"])
        start = np.concatenate(
            [states.reshape(-1), controls.reshape(-1), np.maximum(outside, 0).reshape(-1)]
        )
        answer = self._solver(
            x0=start,
            p=np.concatenate([s, parameters.theta]),
            lbx=np.concatenate([-free, low, np.zeros(n * horizon)]),
            ubx=np.concatenate([free, high, free]),
            lbg=np.concatenate([np.zeros(n * horizon), -free, -free]),
            ubg=np.zeros(3 * n * horizon),
        )
        z = np.asarray(answer["x"]).reshape(-1)
        found = z[n * horizon : (n + m) * horizon].reshape(horizon, m)
        return IpoptSolution(
            float(answer["f"]),
            found[0],
            np.vstack([s, z[: n * horizon].reshape(horizon, n)]),
            found,
            bool(self._solver.stats()["success"]),
        )
