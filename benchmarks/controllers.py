"""The phases of an RTI-NMPC's sample along a closed loop, beside what else could do the same.

References: the same functions interpreted; on every tenth sample ProxQP called cold through
qpsolvers on the same QP, IPOPT on the nonlinear programme, and a Q-learning sample of mpcrl on the
same transition where that is installed (extra `outsiders`).
"""

import warnings
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import qpsolvers

from benchmarks.ipopt import IpoptNmpc
from benchmarks.measuring import clock, figure
from controllers import Problem, RtiNmpc, compile_functions
from controllers.factories import naive
from controllers.qp import DaqpBackend, qpsolvers_problem
from cosim import FmuPlant
from cosim.core.simulation import spawn_seeds

SAMPLE, Q_SAMPLE = "prepare + feedback + dV/dθ", "V(s₊), Q(s, a) and dQ/dθ"
INTERPRETER = "interpreter"
AT_MOST = 60.0
"""Bound of a sample in µs."""
EXPLORATION, WARM_UP, BLOCK, EVERY = 3.0, 20, 50, 10
CONSTRUCTIONS = 20
IPOPT = {"ipopt.tol": 1e-8, "ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-6}


def measure(scenario, steps):
    """Time each phase of a sample in one closed loop; the others follow block by block."""
    controllers = {name: rti_controller(scenario, "daqp") for name in ("DAQP", INTERPRETER)}
    compile_functions(controllers["DAQP"])
    seconds, visits = run(scenario, controllers, steps)
    ours = seconds["DAQP"]
    rows = [
        figure(
            f"DAQP: {phase}", times, INTERPRETER, seconds[INTERPRETER][phase],
            at_most=AT_MOST if phase == SAMPLE else None,
        )
        for phase, times in ours.items()
    ]  # fmt: skip
    references = [
        ("feedback", "qpsolvers, ProxQP, cold", cold_qp),
        (SAMPLE, "IPOPT, warm started", ipopt),
    ]
    if find_spec("mpcrl"):
        references.append((Q_SAMPLE, "mpcrl", mpcrl))
    for phase, name, solver in references:
        times = solver(scenario, visits[::EVERY])
        rows.append(figure(f"DAQP: {phase}", ours[phase][::EVERY], name, times))
    rows.append(figure("a controller more", *construction(scenario)))
    return rows


def construction(scenario):
    """Times to build a controller of a known problem, and of a new one."""
    problem = Problem.from_scenario(scenario)
    parameters = naive(scenario).parameters
    known, new = [], []
    for k in range(CONSTRUCTIONS):
        other = replace(problem, reference_cost=problem.reference_cost + k + 1)
        for times, one in ((new, other), (known, Problem.from_scenario(scenario))):
            begin = clock()
            RtiNmpc(one, parameters)
            times.append(clock() - begin)
    return known, "of a new problem", new


def rti_controller(scenario, backend):
    """The naive RTI-NMPC of a scenario with a QP backend."""
    problem = Problem.from_scenario(scenario)
    parameters, hessian = naive(scenario).parameters, scenario.controller.hessian
    return RtiNmpc(problem, parameters, hessian=hessian, backend=backend)


def run(scenario, controllers, steps):
    """Times by controller and phase, and the visits (linearisation point, s, a, cost, s₊)."""
    seconds = {name: {} for name in controllers}
    visits = []
    plant_seed, rng = spawn_seeds(0)
    with FmuPlant(scenario) as plant:
        s, done = plant.reset(plant_seed), 0
        while done < WARM_UP + steps:
            count = min(BLOCK, WARM_UP + steps - done)
            noise = EXPLORATION * rng.standard_normal((count, scenario.action_lower.size))
            states = []
            for e in noise:
                leader = controllers["DAQP"]
                a = sample(leader, s, e, scenario, seconds["DAQP"])
                step = plant.step(a)
                cost = step.stage_cost + step.penalty
                visits.append((leader.linearisation_point, s, a, cost, step.s))
                states.append(s)
                s = step.s
            for name in [name for name in controllers if name != "DAQP"]:
                for x, e in zip(states, noise, strict=True):
                    sample(controllers[name], x, e, scenario, seconds[name])
            done += count
    kept = {c: {p: times[WARM_UP:] for p, times in own.items()} for c, own in seconds.items()}
    return kept, visits[WARM_UP:]


def sample(controller, s, e, scenario, seconds):
    """Take a sample, add the seconds of its phases, return its action, which `e` explores."""
    times = [clock()]
    controller.prepare()
    times.append(clock())
    solution = controller.feedback(s)
    times.append(clock())
    solution.value_gradient  # noqa: B018 (computed on first access)
    times.append(clock())
    solution.policy_jacobian  # noqa: B018
    times.append(clock())
    a = np.clip(solution.action + e, scenario.action_lower, scenario.action_upper)
    times.append(clock())
    controller.feedback(s, a).value_gradient  # noqa: B018
    times.append(clock())
    begin, prepared, fed_back, graded, moved, explored, end = times
    phases = {
        "prepare": prepared - begin,
        "feedback": fed_back - prepared,
        "V and dV/dθ": graded - prepared,
        "dπ/dθ": moved - graded,
        "Q and dQ/dθ": end - explored,
        SAMPLE: graded - begin,
        Q_SAMPLE: (graded - begin) + (end - explored),
    }
    for phase, value in phases.items():
        seconds.setdefault(phase, []).append(value)
    return a


class Keeper:
    """DAQP, keeping each QP as qpsolvers wants it."""

    def __init__(self):
        self.solver = DaqpBackend()
        self.load = self.solver.load

    def solve(self, qp):
        self.problem = qpsolvers_problem(qp)
        return self.solver.solve(qp)


def cold_qp(scenario, visits):
    """One-shot ProxQP on the same QPs, states and slack as variables."""
    keeper = Keeper()
    controller = rti_controller(scenario, lambda: keeper)
    seconds = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ProxQP takes some feasible QPs for infeasible
        for point, s, *_ in visits:
            controller.prepare_at(point)
            controller.feedback(s)
            begin = clock()
            qpsolvers.solve_problem(keeper.problem, "proxqp", eps_abs=1e-9, eps_rel=0.0)
            seconds.append(clock() - begin)
    return seconds


def ipopt(scenario, visits):
    """IPOPT on the nonlinear programme, started at the RTI's guess."""
    problem = Problem.from_scenario(scenario)
    parameters = naive(scenario).parameters
    solver = IpoptNmpc(problem, parameters.blocks, IPOPT)
    seconds = []
    for point, s, *_ in visits:
        states = np.vstack([point.x[1:], point.x[-1:]])
        begin = clock()
        solver.solve(parameters, s, guess=(states, point.u))
        seconds.append(clock() - begin)
    return seconds


def mpcrl(scenario, visits):
    """mpcrl's Q-learning on the transitions: Q(s, a), its gradient and V(s₊), by IPOPT."""
    from examples.outsiders.mpcrl_nmpc import q_learning_agent

    # No update: θ stays the naive one, as everybody else's here.
    agent = q_learning_agent(Problem.from_scenario(scenario), len(visits) + 1)
    seconds = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a failed solve warns
        for _, *transition in visits:
            begin = clock()
            agent.train_one_rollout([tuple(transition)], 0, raises=False)
            seconds.append(clock() - begin)
    return seconds
