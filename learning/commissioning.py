"""The θ that an engineer has on the first day: tuned, and backed off for a guessed noise.

No sample of the plant goes into it, and nothing that the controller's own model does not say.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.factories import nmpc, tuned
from controllers.functions import StackedFunction
from controllers.model import discretise
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.protocols import recover
from cosim.scenario import Scenario
from learning.algorithm import Transition
from learning.back_off_search import BackOffSearch

GUESS = 0.1
"""Guessed standard deviation of each disturbance, as a share of its nominal value."""
SAMPLES = 8000
"""Samples of the model that the search takes."""
_found: dict[tuple[str, str], Parameters] = {}


def commissioned(scenario: Scenario) -> RtiNmpc:
    """RTI-NMPC with the cost tuned by economics, backed off for a guessed noise (`back_off`)."""
    return nmpc(scenario, back_off(tuned(scenario).parameters, scenario))


def back_off(start: Parameters, scenario: Scenario) -> Parameters:
    """`start` with the back-offs of least cost in a simulation of the controller's own model.

    The disturbances are normal about their nominal values with the deviation `GUESS`, new in each
    sample; `BackOffSearch` moves every bound that binds. Without a nominal disturbance there is no
    noise to guess, and θ stays. What a process has found once it does not search again.
    """
    key = (scenario.hash, start.hash)
    if key not in _found:
        _found[key] = _search(start, scenario)
    return _found[key]


def _search(start: Parameters, scenario: Scenario) -> Parameters:
    problem = Problem.from_scenario(scenario)
    model, penalty = problem.model, scenario.state_penalty
    x, u, d, _ = model.symbols()
    p = ca.SX(ca.DM(model.nominal_parameters))
    after = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
    results = {"y": after, "l": ca.SX(model.economic_cost(x, u, d, p))}
    plant = StackedFunction("f", {"x": x, "u": u, "d": d}, results)
    controller, nominal = nmpc(scenario, start), model.nominal_disturbance
    search = BackOffSearch(start, problem, scenario, SAMPLES, np.random.default_rng(0))

    def sample(s: NDArray[np.float64]) -> Transition:
        controller.prepare()
        policy = controller.feedback(s)
        a = scenario.saturate(policy.action)
        plant.inputs["x"][:], plant.inputs["u"][:] = s, a
        plant.inputs["d"][:] = nominal * (1.0 + GUESS * noise.standard_normal(nominal.size))
        plant()
        after, cost = plant.part("y").copy(), float(plant.part("l")[0])
        due, next_due = penalty(s.tolist()), penalty(after.tolist())
        return Transition(
            0, s, a, False, policy, policy, cost, cost + due, after, next_due, policy, None, None
        )

    begins, s = True, scenario.initial_state
    while not search.done:
        if begins:
            noise, s = np.random.default_rng(search.seed), scenario.initial_state
            controller.reset()
            controller.theta = search.candidate.theta
        try:
            transition = sample(s)
            s = transition.next_s
        except Exception as error:
            recover(controller, error)
            transition = None
        begins = search.observe(transition)
    return search.theta
