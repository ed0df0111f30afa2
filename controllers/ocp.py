"""The parametric optimal control problem of the NMPC, whose QP the RTI solves (eq. param_nmpc)."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.buffered import StackedFunction, stacked
from controllers.dynamics import sampled_jacobian
from controllers.problem import Problem
from controllers.symbolic_theta import SymbolicTheta
from controllers.theta import ThetaBlocks

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Ocp:
    """Symbols and expressions of paper.tex eq. param_nmpc with x_0 = s put in.

    `s` (n,) is the measured state, `x` (n, N) are the states x_1 … x_N, absolute, `u` (m, N) the
    controls; `cost` is all but the penalty of the predicted states; `defects` (n, N) are
    f_θ(x_k, u_k) − x_{k+1}; `outside` (n, N) is max(x_l − x_k, x_k − x_u), whose positive part is
    the least slack. `symbols` are those of θ, `problem` is what the programme was written for.
    """

    s: ca.SX
    x: ca.SX
    u: ca.SX
    symbols: SymbolicTheta
    cost: ca.SX
    defects: ca.SX
    problem: Problem

    @classmethod
    def of(cls, problem: Problem, blocks: ThetaBlocks) -> Ocp:
        """Write the programme for a problem and the blocks of θ."""
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        symbols = SymbolicTheta.of(problem, blocks)
        s = ca.SX.sym("s", n)
        x, u = ca.SX.sym("x", n, horizon), ca.SX.sym("u", m, horizon)
        x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
        states = ca.horzcat(s, x)
        cost = problem.penalty.symbolic(s) + symbols["c_lambda"]
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
    ocp = Ocp.of(problem, blocks)
    return stacked(
        "merit",
        {"s": ocp.s, "x": ocp.x, "u": ocp.u, "theta": ocp.symbols.theta},
        {
            "gradient": ca.gradient(ocp.cost, ca.veccat(ocp.x, ocp.u)),
            "cost": ocp.cost,
            "penalty": ocp.penalty_of(ca.fmax(ocp.outside, 0)),
            "infeasibility": ca.sum1(ca.fabs(ca.vec(ocp.defects))),
        },
    )
