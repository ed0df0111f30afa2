"""How the CPU time of a sample grows with horizon and θ, interpreted beside compiled."""

from itertools import pairwise

import numpy as np

from benchmarks.measuring import clock, figure
from controllers import Parameters, Problem, RtiNmpc, ThetaBlocks, compile_functions
from cosim.core.simulation import spawn_seeds

HORIZONS, SAMPLES, REPETITIONS = (5, 10, 20, 40, 80), 20, 5
PHASES = ("prepare", "feedback", "dV/dθ", "dπ/dθ")
KINDS = {
    "slack weights": {"slack_weights": True},
    "model parameters": {"model_parameters": ("UA2", "h")},
}


def measure(scenario, steps=SAMPLES):
    """Time the phases for each horizon, and at the scenario's own for larger θ."""
    cases = [(horizon, "paper's θ", {}) for horizon in HORIZONS]
    cases += [(scenario.controller.horizon, kind, more) for kind, more in KINDS.items()]
    rows, sums = [], {}
    for horizon, kind, more in cases:
        problem = Problem.from_scenario(scenario.replace({"controller": {"horizon": horizon}}))
        theta = Parameters.naive(problem, ThetaBlocks.from_problem(problem, **more))
        controller = RtiNmpc(problem, theta, hessian=scenario.controller.hessian)
        interpreted = [walk(controller, steps) for _ in range(REPETITIONS)]
        compile_functions(controller)
        compiled = [walk(controller, steps) for _ in range(REPETITIONS)]
        sums[horizon, kind] = [sum(mean.values()) for mean in compiled]
        for phase in PHASES:
            own, others = ([mean[phase] for mean in times] for times in (compiled, interpreted))
            rows.append(figure(f"N = {horizon}, {kind}: {phase}", own, "interpreter", others))
    for shorter, longer in pairwise(HORIZONS):
        own, others = (sums[horizon, "paper's θ"] for horizon in (shorter, longer))
        rows.append(figure(f"N = {shorter}: all of it, compiled", own, f"N = {longer}", others))
    return rows


def walk(controller, samples):
    """Mean seconds of each phase along a random walk of the state."""
    spent = dict.fromkeys(PHASES, 0.0)
    controller.reset()
    reference = controller.problem.reference_state
    rng = spawn_seeds(0)[1]
    for _ in range(samples):
        s = reference + 0.02 * np.abs(reference) * rng.standard_normal(reference.size)
        read = [clock()]
        controller.prepare()
        read.append(clock())
        solution = controller.feedback(s)
        read.append(clock())
        solution.value_gradient  # noqa: B018 (computed on first access)
        read.append(clock())
        solution.policy_jacobian  # noqa: B018
        read.append(clock())
        for phase, seconds in zip(PHASES, np.diff(read), strict=True):
            spent[phase] += float(seconds) / samples
    return spent
