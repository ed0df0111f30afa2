"""The naive NMPC in mpcrl's own terms, and its Q-learning agent: what others' code makes of it.

Needs the extra `outsiders`; the agent beside it and the benchmark use it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from csnlp import Nlp
from csnlp.wrappers import Mpc
from mpcrl import LearnableParameter, LearnableParametersDict, LstdQLearningAgent, UpdateStrategy
from mpcrl.optim import NewtonMethod
from numpy.typing import NDArray

from controllers.model import discretise
from controllers.problem import Problem

Vector = NDArray[np.float64]


class NaiveNmpc(Mpc[ca.SX]):  # type: ignore[misc]
    """The paper's NMPC with the naive guess, learnable where `start` names a parameter.

    `start` maps c_lambda, b_l, c_f and x_l, blocks of the benchmark's θ, to their values. IPOPT
    solves it. The penalty of the known state s, which no action changes, is left out.
    """

    def __init__(self, problem: Problem, start: Mapping[str, Vector]) -> None:
        super().__init__(Nlp[ca.SX](), problem.horizon)
        n, m, N = problem.n_states, problem.n_actions, problem.horizon
        x, _ = self.state("x", n, bound_initial=False)
        u, _ = self.action(
            "u", m, lb=problem.action_lower[:, None], ub=problem.action_upper[:, None]
        )
        slack, _, _ = self.variable("slack", (n, N), lb=0)
        theta = {name: self.parameter(name, (len(value), 1)) for name, value in start.items()}
        model = problem.model
        step = discretise(model, problem.sampling_time, problem.substeps)
        d, p = model.nominal_disturbance, model.nominal_parameters
        for k in range(N):
            following = step(x[:, k], u[:, k], d, p) + theta["c_f"]
            self.constraint(f"dynamics_{k}", x[:, k + 1], "==", following)
        self.constraint("lower", theta["x_l"] - slack, "<=", x[:, 1:])
        self.constraint("upper", x[:, 1:], "<=", problem.state_upper + slack)
        gamma = problem.discount
        cost = theta["c_lambda"] + gamma**N * ca.sumsqr(x[:, N] - problem.reference_state)
        for k in range(N):
            w = ca.vertcat(x[:, k] - problem.reference_state, u[:, k] - problem.reference_action)
            s = slack[:, k]
            penalty = ca.dot(problem.penalty_linear, s) + ca.dot(problem.penalty_quadratic, s**2)
            cost += gamma**k * (ca.sumsqr(w) + ca.dot(theta["b_l"], w)) + gamma ** (k + 1) * penalty
        self.minimize(cost)
        ipopt = {"max_iter": 300, "sb": "yes", "print_level": 0}
        self.init_solver({"expand": True, "print_time": False, "ipopt": ipopt}, solver="ipopt")


def naive_start(problem: Problem) -> dict[str, Vector]:
    """What the NMPC learns, at the naive guess, by the names of θ's blocks."""
    return {
        "c_lambda": np.array([problem.reference_cost / (1.0 - problem.discount)]),
        "b_l": np.zeros(problem.n_states + problem.n_actions),
        "c_f": np.zeros(problem.n_states),
        "x_l": problem.state_lower.copy(),
    }


def q_learning_agent(problem: Problem, update_every: int = 100, **options: Any) -> Any:
    """mpcrl's second-order LSTD Q-learning on the naive NMPC; `options` go to its constructor."""
    start = naive_start(problem)
    learnable = LearnableParametersDict[ca.SX](
        LearnableParameter(name, value.shape, value) for name, value in start.items()
    )
    return LstdQLearningAgent(
        mpc=NaiveNmpc(problem, start),
        learnable_parameters=learnable,
        discount_factor=problem.discount,
        update_strategy=UpdateStrategy(update_every),
        optimizer=NewtonMethod(learning_rate=0.3, max_percentage_update=0.2),
        hessian_type="approx",
        remove_bounds_on_initial_action=True,
        **options,
    )
