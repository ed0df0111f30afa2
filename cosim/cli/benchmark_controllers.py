"""Times the controllers along a real run: per QP backend, and against two common ways to solve it.

The command line is where packages are put together, so this module may use plant, loop and
controllers at once.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import qpsolvers

from controllers import LinearisationPoint, Problem, RtiNmpc
from controllers.factories import naive_parameters
from controllers.ipopt import IpoptNmpc
from controllers.qp import QpBackend, QpSolution, SoftQp
from controllers.qp.daqp_backend import DaqpBackend
from controllers.qp.qpsolvers_backend import full_space
from cosim.cli.compose import build_plant
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds

BACKENDS = ("daqp", "proxqp")
TARGETS = {"daqp": 120.0, "proxqp": 250.0}
PHASES = ("prepare", "feedback", "V and dV/dθ", "dπ/dθ", "Q and dQ/dθ")
SAMPLE = "prepare + feedback + dV/dθ"
WARM_START = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-6}
EXPLORATION = 3.0
WARM_UP = 20


class Visit(NamedTuple):
    """What one sample of the run asked of the controller."""

    point: LinearisationPoint
    s: np.ndarray
    a: np.ndarray


def measure(
    scenario: Scenario, steps: int, every: int, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Time each phase of a sample in µs, and per-sample ratios of the alternatives to it.

    Each backend runs its own closed loop of `steps` samples with the same seed: what is timed is
    a new QP at a new state each time. `V and dV/dθ` is the feedback with the value's gradient,
    `dπ/dθ` the Jacobian beyond that, `Q and dQ/dθ` the feedback with an explored action and its
    gradient. On every `every`-th sample of the first run the same QP goes to qpsolvers cold, and
    the nonlinear programme at the same state to IPOPT, started from the RTI's guess. `progress`
    gets the number of samples done.
    """
    seconds: dict[str, dict[str, list[float]]] = {}
    rows: list[dict[str, Any]] = []
    visits: list[Visit] = []
    for number, backend in enumerate(BACKENDS):
        done = number * steps
        seconds[backend], seen = _run(scenario, backend, steps, done, progress)
        visits = visits or seen
        whole = np.array(seconds[backend]["prepare"]) + np.array(seconds[backend]["V and dV/dθ"])
        rows += [_row(backend, phase, values) for phase, values in seconds[backend].items()]
        rows.append(_row(backend, SAMPLE, whole.tolist(), TARGETS[backend]))
    first = seconds[BACKENDS[0]]
    picked = range(0, steps, every)
    sample = [first["prepare"][k] + first["V and dV/dθ"][k] for k in picked]
    chosen = [visits[k] for k in picked]
    feedback = [first["feedback"][k] for k in picked]
    for name, (values, solved), ours, phase in (
        ("qpsolvers, proxqp, cold", _cold_qp(scenario, chosen), feedback, "feedback"),
        ("IPOPT, warm started", _ipopt(scenario, chosen), sample, SAMPLE),
    ):
        row = _row(name, "solve", values)
        row["ratio"] = median(other / own for other, own in zip(values, ours, strict=True))
        row["ratio_to"] = f"{BACKENDS[0]} {phase}"
        row["solved_share"] = solved / len(values)
        rows.append(row)
    return {
        "scenario": scenario.name,
        "hessian": scenario.controller.hessian,
        "steps": steps,
        "compared": len(chosen),
        "rows": rows,
    }


def _row(
    solver: str, phase: str, values: list[float], target: float | None = None
) -> dict[str, Any]:
    typical = 1e6 * median(values)
    return {
        "solver": solver,
        "phase": phase,
        "median_us": typical,
        "minimum_us": 1e6 * min(values),
        "p95_us": 1e6 * float(np.quantile(values, 0.95)),
        "target_us": target,
        "met": None if target is None else typical <= target,
        "ratio": None,
        "ratio_to": None,
        "solved_share": 1.0,
    }


def _controller(scenario: Scenario, backend: str | Callable[[], QpBackend]) -> RtiNmpc:
    problem = Problem.from_scenario(scenario)
    return RtiNmpc(
        problem,
        naive_parameters(scenario, problem),
        hessian=scenario.controller.hessian,
        backend=backend,
    )


def _run(
    scenario: Scenario, backend: str, steps: int, done: int, progress: Callable[[int], None]
) -> tuple[dict[str, list[float]], list[Visit]]:
    """Run the closed loop and time the phases of each sample."""
    seconds: dict[str, list[float]] = {phase: [] for phase in PHASES}
    visits: list[Visit] = []
    controller = _controller(scenario, backend)
    plant_seed, rng = spawn_seeds(0)
    lower, upper = scenario.action_lower, scenario.action_upper
    with build_plant(scenario) as plant:
        s = plant.reset(plant_seed)
        for k in range(WARM_UP + steps):
            begin = perf_counter()
            controller.prepare()
            prepared = perf_counter()
            solution = controller.feedback(s)
            fed_back = perf_counter()
            solution.value_gradient  # noqa: B018 (computed on first access)
            graded = perf_counter()
            solution.policy_jacobian  # noqa: B018
            moved = perf_counter()
            a = np.clip(
                solution.action + EXPLORATION * rng.standard_normal(lower.size), lower, upper
            )
            explored = perf_counter()
            controller.feedback(s, a).value_gradient  # noqa: B018
            end = perf_counter()
            if k >= WARM_UP:
                for phase, value in zip(
                    PHASES,
                    (
                        prepared - begin,
                        fed_back - prepared,
                        graded - prepared,
                        moved - graded,
                        end - explored,
                    ),
                    strict=True,
                ):
                    seconds[phase].append(value)
                visits.append(Visit(controller.linearisation_point, s, a))
                progress(done + k - WARM_UP + 1)
            s = plant.step(a).s
    return seconds, visits


class _Keeper:
    """DAQP, keeping each QP as qpsolvers wants it."""

    def __init__(self) -> None:
        self._solver = DaqpBackend()
        self.load = self._solver.load
        self.problem: Any = None

    def solve(self, qp: SoftQp) -> QpSolution:
        """Keep and solve."""
        self.problem, _ = full_space(qp, dense=True)
        return self._solver.solve(qp)


def _cold_qp(scenario: Scenario, visits: list[Visit]) -> tuple[list[float], int]:
    """Time one-shot ProxQP on the same QPs, states and slack as variables; count the solved."""
    keeper = _Keeper()
    controller = _controller(scenario, lambda: keeper)
    seconds, solved = [], 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ProxQP takes some feasible QPs for infeasible: counted
        for visit in visits:
            controller.prepare_at(visit.point)
            controller.feedback(visit.s)
            begin = perf_counter()
            answer = qpsolvers.solve_problem(keeper.problem, "proxqp", eps_abs=1e-9, eps_rel=0.0)
            seconds.append(perf_counter() - begin)
            solved += bool(answer.found)
    return seconds, solved


def _ipopt(scenario: Scenario, visits: list[Visit]) -> tuple[list[float], int]:
    """Time IPOPT on the nonlinear programme, started at the RTI's guess; count the solved."""
    problem = Problem.from_scenario(scenario)
    parameters = naive_parameters(scenario, problem)
    solver = IpoptNmpc(problem, parameters.blocks, {"ipopt.tol": 1e-8} | WARM_START)
    seconds, solved = [], 0
    for visit in visits:
        states = np.vstack([visit.point.x[1:], visit.point.x[-1:]])
        begin = perf_counter()
        answer = solver.solve(parameters, visit.s, guess=(states, visit.point.u))
        seconds.append(perf_counter() - begin)
        solved += answer.success
    return seconds, solved
