"""The θ that an engineer has on the first day: tuned, and backed off for a guessed noise.

It comes from the controller's own model alone, without a sample of the plant.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from controllers.factories import nmpc, tuned
from controllers.functions import StackedFunction
from controllers.model import discretise
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.protocols import Array
from cosim.scenario import Scenario
from cosim.simulation import recover
from learning.algorithm import Transition
from learning.baselines import BackOffSearch
from learning.prediction_errors import OneStepModel

GUESS = 0.1
"""Guessed standard deviation of each disturbance, as a share of its nominal value."""
SAMPLES = 8000
"""Samples of the model that the search takes."""
SPARE, SPARE_SAMPLES = 18.0, 1000
"""A spare back-off in standard deviations of the one-step error, and the samples that it takes."""
_found: dict[tuple[str, str], Parameters] = {}


def commissioned(scenario: Scenario) -> RtiNmpc:
    """RTI-NMPC with the cost tuned by economics, backed off for a guessed noise (`back_off`)."""
    return nmpc(scenario, back_off(tuned(scenario).parameters, scenario))


def cautious(scenario: Scenario) -> RtiNmpc:
    """As `commissioned`, with a spare back-off of each bound that does not bind (`spare`)."""
    return nmpc(scenario, spare(back_off(tuned(scenario).parameters, scenario), scenario))


def back_off(start: Parameters, scenario: Scenario) -> Parameters:
    """`start` with the back-offs of least cost in a simulation of the controller's own model.

    The disturbances are normal about their nominal values with the deviation `GUESS`, new in each
    sample; `BackOffSearch` moves every bound that binds. Without a nominal disturbance there is no
    noise to guess, and θ stays. A process searches once for each scenario and start.
    """
    key = (scenario.hash, start.hash)
    if key in _found:
        return _found[key]
    sample = _simulation(scenario)
    controller = nmpc(scenario, start)
    search = BackOffSearch(start, scenario, SAMPLES, np.random.default_rng(0))
    for segment in search.plan():
        noise, s = np.random.default_rng(segment.seed), scenario.initial_state
        controller.reset()
        controller.theta, ended = segment.theta, False
        while not ended:
            transition = None
            try:
                transition = sample(controller, s, noise)
                s = transition.next_s
            except Exception as error:
                recover(controller, error)
            ended = segment.take(transition, 0.0)
        segment.answer = search.told(segment)
    _found[key] = search.theta
    return _found[key]


def spare(start: Parameters, scenario: Scenario) -> Parameters:
    """`start` with each bound that never binds in such a simulation set back by `SPARE`.

    Where half of the distance to the nearest state of the simulation is less, it is that half. It
    costs nothing on the model, and is a reserve for a plant whose states lie elsewhere.
    """
    controller, sample = nmpc(scenario, start), _simulation(scenario)
    noise, s = np.random.default_rng(0), scenario.initial_state
    samples = []
    for _ in range(SPARE_SAMPLES):
        samples.append(sample(controller, s, noise))
        s = samples[-1].next_s
    states, actions, following = (
        np.array([getattr(one, name) for one in samples]) for name in ("s", "a", "next_s")
    )
    errors = OneStepModel(scenario).errors(states, actions, following, start)
    gradients = np.array([one.policy.value_gradient for one in samples])
    rooms = {"x_l": states.min(axis=0) - start["x_l"], "x_u": start["x_u"] - states.max(axis=0)}
    most = SPARE * errors.std(axis=0)
    moved = {}
    for name, sign in (("x_l", 1.0), ("x_u", -1.0)):
        binds = (gradients[:, start.blocks.slices[name]] != 0).any(axis=0)
        distance = np.clip(rooms[name] / 2, 0.0, most)
        moved[name] = start[name] + sign * np.where(binds, 0.0, distance)
    return start.replace(moved)


def _simulation(
    scenario: Scenario,
) -> Callable[[RtiNmpc, Array, np.random.Generator], Transition]:
    """A sample of a controller on its own model, from a state (n,), with guessed noise."""
    problem = Problem.from_scenario(scenario)
    model, penalty = problem.model, scenario.state_penalty
    x, u, d, _ = model.symbols()
    p = ca.SX(ca.DM(model.nominal_parameters))
    after = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
    results = {"y": after, "l": ca.SX(model.economic_cost(x, u, d, p))}
    plant = StackedFunction("f", {"x": x, "u": u, "d": d}, results)
    nominal = model.nominal_disturbance

    def sample(controller: RtiNmpc, s: Array, noise: np.random.Generator) -> Transition:
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

    return sample
