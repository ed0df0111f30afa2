"""A sample of output feedback, filter and RTI-NMPC, beside the RTI-NMPC that is given the state.

Both compiled, on the readings of one closed loop, in turns: `-s assay`, `late` or `levels`.
"""

import numpy as np

from benchmarks.measuring import clock, figure
from controllers import ExtendedKalmanFilter, OutputFeedback, compile_functions
from controllers.factories import naive, nmpc
from cosim import FmuPlant
from cosim.core.errors import ScenarioError
from cosim.core.simulation import spawn_seeds

AT_MOST = 1.3
"""Times as long as the RTI-NMPC alone that a sample with the filter may take."""
WARM_UP = 100
KINDS = ("compiled", "interpreted")
PLAIN = "prepare + feedback"
GRADIENT = "prepare + feedback + dV/dθ"


def measure(scenario, steps):
    """Rows of a sample with the filter, compiled and not, without derivatives and with them."""
    if not scenario.sensors:
        raise ScenarioError(f"scenario '{scenario.name}' has no sensors: give -s assay")
    theta = naive(scenario).parameters
    noisy = ExtendedKalmanFilter.from_scenario(scenario).add_noise(theta)
    # θ with the block `noise` has the filter differentiate.
    thetas = {PLAIN: theta, GRADIENT: noisy}
    alone = {name: nmpc(scenario, theta) for name in thetas}
    laws = {}
    for name, given in thetas.items():
        compile_functions(alone[name])
        for kind in KINDS:
            laws[name, kind] = OutputFeedback.from_scenario(scenario, nmpc(scenario, given))
        compile_functions(laws[name, "compiled"])
        # The controller alone: the filter stays Python's.
        compile_functions(laws[name, "interpreted"].controller)
    seconds = {key: [] for key in (*laws, *alone)}
    plant_seed, _ = spawn_seeds(0)
    with FmuPlant(scenario) as plant:
        plant.reset(plant_seed)
        for _ in range(WARM_UP + steps):
            for (name, kind), law in laws.items():
                solution = sample(law, plant.y, name == GRADIENT, seconds[name, kind])
            estimate = law.estimate
            for name, controller in alone.items():
                sample(controller, estimate, name == GRADIENT, seconds[name])
            # All filters have the same estimate, and are told the same action.
            action = np.clip(solution.action, scenario.action_lower, scenario.action_upper)
            for law in laws.values():
                law.applied(action)
            plant.step(action)
    rows = []
    for name, kind in laws:
        bound = 1 / AT_MOST if (name, kind) == (PLAIN, "compiled") else None
        times = seconds[name, kind][WARM_UP:]
        reference = seconds[name][WARM_UP:]
        label = f"{kind} filter: {name}"
        rows.append(figure(label, times, "RTI alone", reference, at_least=bound))
    return rows


def sample(law, given, gradient, seconds):
    """Take a sample, add its seconds, return its solution."""
    begin = clock()
    law.prepare()
    solution = law.feedback(given)
    if gradient:
        solution.value_gradient  # noqa: B018 (computed on first access)
    seconds.append(clock() - begin)
    return solution
