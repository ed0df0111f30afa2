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
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.core.simulation import recover
from learning.algorithm import Transition
from learning.back_off import BackOffConfiguration, BackOffSearch
from learning.empirical_model import displaced
from learning.prediction_errors import OneStepModel

Sample = Callable[[RtiNmpc, Array, np.random.Generator], Transition]
"""A sample of a controller on its own model, from a state (n,), with guessed noise."""
_searched: dict[tuple[str, str, float, int], Parameters] = {}


def backed_off(scenario: Scenario) -> RtiNmpc:
    """RTI-NMPC with the cost tuned by economics, backed off for a guessed noise (`back_off`)."""
    return nmpc(scenario, back_off(tuned(scenario).parameters, scenario))


def cautious(scenario: Scenario) -> RtiNmpc:
    """As `backed_off`, with a reserve back-off of each bound that is not active."""
    start = back_off(tuned(scenario).parameters, scenario)
    return nmpc(scenario, add_reserve(start, scenario))


def back_off(
    start: Parameters,
    scenario: Scenario,
    deviation: float = 0.1,
    samples: int = 8000,
) -> Parameters:
    """Back-offs of least cost in a simulation of the controller's own model.

    `BackOffSearch` moves every active bound. Without a nominal disturbance there is no noise to
    guess, and θ stays. A process searches once for each scenario, start and noise.

    Args:
        start: θ with no bound backed off.
        scenario: bounds, penalty and nominal model.
        deviation: guessed standard deviation of each disturbance, as a share of its magnitude;
            they are normal about this, new in each sample.
        samples: of the model that the search takes.
    """
    # A study asks for the same θ in every run.
    key = (scenario.hash, start.hash, deviation, samples)
    if key in _searched:
        return _searched[key]
    sample = _simulation(scenario, deviation)
    controller = nmpc(scenario, start)
    rng = np.random.default_rng(0)
    search = BackOffSearch(start, scenario, samples, rng, BackOffConfiguration.from_dict({}))
    while not search.has_ended:
        # A segment begins at the initial state; all of a round meet the same noise.
        noise = np.random.default_rng(search.seed)
        controller.reset()
        controller.theta = search.trial.theta
        s = scenario.initial_state
        segment_has_ended = False
        while not segment_has_ended:
            transition: Transition | None = None
            try:
                transition = sample(controller, s, noise)
                s = transition.next_s
            except Exception as error:
                recover(controller, error)
            segment_has_ended = search.observe(transition)
    _searched[key] = search.theta
    return search.theta


def add_reserve(
    start: Parameters,
    scenario: Scenario,
    deviation: float = 0.1,
    reserve: float = 18.0,
    samples: int = 1000,
) -> Parameters:
    """`start` with a reserve back-off of each bound that is never active in such a simulation.

    Where half of the distance to the nearest state of the simulation is less, it is that half. It
    costs nothing on the model, and is a reserve for a plant whose states lie elsewhere.

    Args:
        start: θ with the active bounds backed off.
        scenario: bounds, penalty and nominal model.
        deviation: guessed standard deviation of each disturbance, as a share of its magnitude.
        reserve: the back-off, in standard deviations of the one-step error.
        samples: of the simulation.
    """
    controller = nmpc(scenario, start)
    sample = _simulation(scenario, deviation)
    noise = np.random.default_rng(0)
    s = scenario.initial_state
    transitions = []
    # One run: where do the states go, and which bounds are active?
    for _ in range(samples):
        transition = sample(controller, s, noise)
        transitions.append(transition)
        s = transition.next_s
    states = np.array([transition.s for transition in transitions])
    actions = np.array([transition.a for transition in transitions])
    next_states = np.array([transition.next_s for transition in transitions])
    gradients = np.array([transition.solution.value_gradient for transition in transitions])
    errors = OneStepModel(scenario).errors(states, actions, next_states, start)
    most = reserve * errors.std(axis=0)

    slices = start.blocks.slices
    below = np.clip((states.min(axis=0) - start["x_l"]) / 2, 0.0, most)
    above = np.clip((start["x_u"] - states.max(axis=0)) / 2, 0.0, most)
    lower_active = (gradients[:, slices["x_l"]] != 0).any(axis=0)
    upper_active = (gradients[:, slices["x_u"]] != 0).any(axis=0)
    return start.replace(
        {
            "x_l": start["x_l"] + np.where(lower_active, 0.0, below),
            "x_u": start["x_u"] - np.where(upper_active, 0.0, above),
        }
    )


def _simulation(scenario: Scenario, deviation: float) -> Sample:
    """A function that takes a sample of a controller on its own model."""
    problem = Problem.from_scenario(scenario)
    model = problem.model
    x, u, d, _ = model.symbols()
    p = ca.SX(ca.DM(model.nominal_parameters))
    next_x = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
    results = {"y": next_x, "l": ca.SX(model.economic_cost(x, u, d, p))}
    plant = StackedFunction("f", {"x": x, "u": u, "d": d}, results)
    nominal = model.nominal_disturbance
    magnitudes = model.disturbance_magnitudes

    def sample(
        controller: RtiNmpc,
        s: Array,
        noise: np.random.Generator,
    ) -> Transition:
        controller.prepare()
        solution = controller.feedback(s)
        a = scenario.saturate(solution.action)
        plant.inputs["x"][:] = s
        plant.inputs["u"][:] = a
        # In proportion to their magnitudes: nobody knows more on the first day.
        share = deviation * noise.standard_normal(nominal.size)
        plant.inputs["d"][:] = displaced(nominal, magnitudes, share)
        plant()
        next_s = plant.part("y").copy()
        stage_cost = float(plant.part("l")[0])
        return Transition(
            number=0,
            s=s,
            a=a,
            explored=False,
            solution=solution,
            q_solution=solution,
            stage_cost=stage_cost,
            cost=stage_cost + scenario.state_penalty(s.tolist()),
            next_s=next_s,
            next_penalty=scenario.state_penalty(next_s.tolist()),
            next_solution=solution,
            point=None,
            next_point=None,
        )

    return sample
