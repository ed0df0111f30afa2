"""The parametric NMPC solved by IPOPT: an independent implementation, for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.model import discretise
from controllers.problem import Problem
from controllers.theta import Parameters, ThetaBlocks, symbolic_theta

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Ocp:
    """Symbols and expressions of paper.tex eq. param_nmpc with x_0 = s put in.

    `s` (n,) is the measured state, `x` (n, N) are the states x_1 … x_N, absolute, `u` (m, N) the
    controls; `cost` is all but the penalty of the predicted states; `defects` (n, N) are
    f_θ(x_k, u_k) − x_{k+1}. `symbols` are those of θ, `problem` is what it was written for.
    """

    s: ca.SX
    x: ca.SX
    u: ca.SX
    symbols: dict[str, ca.SX]
    cost: ca.SX
    defects: ca.SX
    problem: Problem

    @classmethod
    def of(cls, problem: Problem, blocks: ThetaBlocks) -> Ocp:
        """Write the programme for a problem and the blocks of θ."""
        model = problem.model
        f = discretise(model, problem.sampling_time, problem.substeps)
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        symbols = symbolic_theta(problem, blocks)
        s = ca.SX.sym("s", n)
        x, u = ca.SX.sym("x", n, horizon), ca.SX.sym("u", m, horizon)
        x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
        states, p = ca.horzcat(s, x), symbols["model_parameters"]
        cost = problem.symbolic_penalty(s) + symbols["c_lambda"]
        cost += ca.bilin(symbols["B_lambda"], s - x_s) + ca.dot(symbols["b_lambda"], s - x_s)
        defects = []
        for k in range(horizon):
            w = ca.vertcat(states[:, k] - x_s, u[:, k] - u_s)
            stage = ca.bilin(symbols["B_l"], w) + ca.dot(symbols["b_l"], w)
            cost += problem.discount**k * stage
            x_next = f(states[:, k], u[:, k], model.nominal_disturbance, p)
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
        ocp = Ocp.of(problem, blocks)
        slack = ca.SX.sym("slack", problem.n_states, problem.horizon)
        z = ca.veccat(ocp.x, ocp.u, slack)
        lower = ca.repmat(ocp.symbols["x_l"], 1, problem.horizon) - ocp.x - slack
        upper = ocp.x - ca.repmat(ocp.symbols["x_u"], 1, problem.horizon) - slack
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
                "p": ca.veccat(ocp.s, ocp.symbols["theta"]),
                "f": ocp.cost + ocp.penalty_of(slack),
                "g": ca.veccat(ocp.defects, lower, upper),
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
