"""What else does an RTI-NMPC's work: qpsolvers cold, IPOPT, mpcrl; timed on the same samples."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import qpsolvers

from controllers import LinearisationPoint, Problem, RtiNmpc
from controllers.factories import naive_parameters
from controllers.ipopt import IpoptNmpc
from controllers.qp import QpBackend, QpSolution, SoftQp
from controllers.qp.daqp_backend import DaqpBackend
from controllers.qp.explicit_slack import qpsolvers_problem
from cosim.cli.benchmark.figures import clock
from cosim.scenario import Scenario

SAMPLE = "prepare + feedback + dV/dθ"
Q_SAMPLE = "V(s₊), Q(s, a) and dQ/dθ"
WARM_START = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-6}


class Visit(NamedTuple):
    """One sample of the loop: where the QP was linearised, s, the action applied, what came."""

    point: LinearisationPoint
    s: np.ndarray
    a: np.ndarray
    cost: float
    next_s: np.ndarray


def rti_controller(scenario: Scenario, backend: str | Callable[[], QpBackend]) -> RtiNmpc:
    """The naive RTI-NMPC of a scenario with a QP backend."""
    problem = Problem.from_scenario(scenario)
    return RtiNmpc(
        problem,
        naive_parameters(scenario, problem),
        hessian=scenario.controller.hessian,
        backend=backend,
    )


def references(
    scenario: Scenario, visits: Sequence[Visit]
) -> list[tuple[str, str, list[float], int]]:
    """The phase, what else does it, its seconds on every visit, and how many it solved."""
    found = [
        ("feedback", "qpsolvers, ProxQP, cold", *_cold_qp(scenario, visits)),
        (SAMPLE, "IPOPT, warm started", *_ipopt(scenario, visits)),
    ]
    if find_spec("mpcrl"):
        found.append((Q_SAMPLE, "mpcrl", *_mpcrl(scenario, visits)))
    return found


class _Keeper:
    """DAQP, keeping each QP as qpsolvers wants it."""

    def __init__(self) -> None:
        self._solver = DaqpBackend()
        self.load = self._solver.load
        self.problem: Any = None

    def solve(self, qp: SoftQp) -> QpSolution:
        """Keep and solve."""
        self.problem = qpsolvers_problem(qp)
        return self._solver.solve(qp)


def _cold_qp(scenario: Scenario, visits: Sequence[Visit]) -> tuple[list[float], int]:
    """One-shot ProxQP on the same QPs, states and slack as variables."""
    keeper = _Keeper()
    controller = rti_controller(scenario, lambda: keeper)
    seconds, solved = [], 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ProxQP takes some feasible QPs for infeasible: counted
        for visit in visits:
            controller.prepare_at(visit.point)
            controller.feedback(visit.s)
            begin = clock()
            answer = qpsolvers.solve_problem(keeper.problem, "proxqp", eps_abs=1e-9, eps_rel=0.0)
            seconds.append(clock() - begin)
            solved += bool(answer.found)
    return seconds, solved


def _ipopt(scenario: Scenario, visits: Sequence[Visit]) -> tuple[list[float], int]:
    """IPOPT on the nonlinear programme, started at the RTI's guess."""
    problem = Problem.from_scenario(scenario)
    parameters = naive_parameters(scenario, problem)
    solver = IpoptNmpc(problem, parameters.blocks, {"ipopt.tol": 1e-8} | WARM_START)
    seconds, solved = [], 0
    for visit in visits:
        states = np.vstack([visit.point.x[1:], visit.point.x[-1:]])
        begin = clock()
        answer = solver.solve(parameters, visit.s, guess=(states, visit.point.u))
        seconds.append(clock() - begin)
        solved += answer.success
    return seconds, solved


def _mpcrl(scenario: Scenario, visits: Sequence[Visit]) -> tuple[list[float], int]:
    """mpcrl's Q-learning on the transitions: Q(s, a), its gradient and V(s₊), by IPOPT."""
    from controllers.mpcrl_nmpc import q_learning_agent

    # No update: θ stays the naive one, as everybody else's here.
    never = len(visits) + 1
    agent = q_learning_agent(Problem.from_scenario(scenario), never, record_td_errors=True)
    seconds = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a failed solve warns: counted
        for visit in visits:
            transition = (visit.s, visit.a, visit.cost, visit.next_s)
            begin = clock()
            agent.train_one_rollout([transition], 0, raises=False)
            seconds.append(clock() - begin)
    return seconds, int(np.isfinite(agent.td_errors).sum())
