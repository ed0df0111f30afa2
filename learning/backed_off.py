"""The θ that an engineer has on the first day: tuned, and backed off for a guessed noise.

It comes from the controller's own model alone, without a sample of the plant.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from controllers.errors import TuningError
from controllers.estimator import EXPECTED_DISTURBANCE, measured
from controllers.factories import nmpc, tuned
from controllers.filter_model import measured_outputs
from controllers.functions import StackedFunction, define
from controllers.model import discretise
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.protocols import Array, Step
from cosim.core.scenario import Scenario
from cosim.core.sensors import Sensors
from cosim.core.simulation import ClosedLoop, Sample
from learning.algorithm import Transition
from learning.back_off import BackOffConfiguration, BackOffSearch
from learning.empirical_model import displaced
from learning.prediction_errors import OneStepModel

_searched: dict[tuple[str, str, float, int], Parameters] = {}
"""θ that this process has searched already, by scenario, start, deviation and samples."""


def backed_off(scenario: Scenario) -> RtiNmpc:
    """RTI-NMPC with the cost tuned by economics, backed off for a guessed noise (`back_off`)."""
    start = tuned(scenario).parameters
    return nmpc(scenario, back_off(start, scenario))


def cautious(scenario: Scenario) -> RtiNmpc:
    """As `backed_off`, with a reserve back-off of each bound that is not active."""
    start = tuned(scenario).parameters
    start = back_off(start, scenario)
    return nmpc(scenario, add_reserve(start, scenario))


def back_off(
    start: Parameters,
    scenario: Scenario,
    deviation: float = EXPECTED_DISTURBANCE,
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

    Raises:
        TuningError: No sample of the simulation was solved.
    """
    # Nobody has trained for a signal; θ is what it moves from.
    scenario = scenario.still
    # A study asks for the same θ in every run.
    key = (scenario.hash, start.hash, deviation, samples)
    if key in _searched:
        return _searched[key]
    plant = GuessedPlant(scenario, deviation)
    controller = nmpc(scenario, start)
    law = measured(scenario, controller)
    loop = ClosedLoop(plant.step, law, scenario)
    rng = np.random.default_rng(0)
    settings = BackOffConfiguration.from_dict({})
    search = BackOffSearch(start, scenario, samples, rng, settings)
    n_solved = 0
    while not search.has_ended:
        controller.theta = search.trial.theta
        # A segment begins at the initial state; all of a round meet the same noise.
        loop.start(plant.reset(search.seed), plant.y)
        segment_has_ended = False
        while not segment_has_ended:
            sample = loop.advance()
            n_solved += sample.solution is not None
            segment_has_ended = search.observe(_transition(sample, scenario))
    _require_a_solution(n_solved, scenario)
    _searched[key] = search.theta
    return search.theta


def add_reserve(
    start: Parameters,
    scenario: Scenario,
    deviation: float = EXPECTED_DISTURBANCE,
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

    Raises:
        TuningError: No sample of the simulation was solved.
    """
    scenario = scenario.still
    plant = GuessedPlant(scenario, deviation)
    controller = nmpc(scenario, start)
    law = measured(scenario, controller)
    loop = ClosedLoop(plant.step, law, scenario)
    loop.start(plant.reset(0), plant.y)
    transitions = []
    # One run: where do the states go, and which bounds are active?
    for _ in range(samples):
        sample = loop.advance()
        transition = _transition(sample, scenario)
        if transition is not None:
            transitions.append(transition)
    _require_a_solution(len(transitions), scenario)
    states = np.array([transition.s for transition in transitions])
    actions = np.array([transition.a for transition in transitions])
    next_states = np.array([transition.next_s for transition in transitions])
    gradients = np.array([transition.solution.value_gradient for transition in transitions])
    model = OneStepModel(scenario)
    errors = model.errors(states, actions, next_states, start)
    most = reserve * errors.std(axis=0)

    # Half of what the states have left free.
    lower = start["x_l"]
    upper = start["x_u"]
    room_below = states.min(axis=0) - lower
    room_above = upper - states.max(axis=0)
    below = np.clip(room_below / 2, 0.0, most)
    above = np.clip(room_above / 2, 0.0, most)
    # A bound that was active has its back-off already: its multiplier is dV/dx_l or dV/dx_u.
    slices = start.blocks.slices
    lower_multipliers = gradients[:, slices["x_l"]]
    upper_multipliers = gradients[:, slices["x_u"]]
    lower_active = (lower_multipliers != 0).any(axis=0)
    upper_active = (upper_multipliers != 0).any(axis=0)
    below = np.where(lower_active, 0.0, below)
    above = np.where(upper_active, 0.0, above)
    return start.replace({"x_l": lower + below, "x_u": upper - above})


class GuessedPlant:
    """The controller's own model as a plant, its disturbances normal about their nominal values.

    The scenario's sensors measure it as they do the plant.

    Args:
        scenario: names the model, and the sensors.
        deviation: standard deviation of each disturbance, as a share of its nominal value: no
            scenario says more on the first day.

    Attributes:
        y: what the sensors show at the present sample, (n_y,); None without sensors.
    """

    def __init__(self, scenario: Scenario, deviation: float) -> None:
        problem = Problem.from_scenario(scenario)
        model = problem.model
        x, u, d, _ = model.symbols()
        # Nobody knows better parameters than the nominal ones on the first day.
        p = ca.SX(ca.DM(model.nominal_parameters))
        simulate = discretise(model, problem.sampling_time, problem.substeps)
        next_x = simulate(x, u, d, p)
        cost = ca.SX(model.economic_cost(x, u, d, p))
        arguments = {"x": x, "u": u, "d": d}
        results = {"y": next_x, "l": cost}
        definition = define("f", arguments, results)
        self.scenario = scenario
        self._deviation = deviation
        self._function = StackedFunction(definition)
        self._nominal = model.nominal_disturbance
        self._magnitudes = model.disturbance_magnitudes
        self._sensors: Sensors | None = None
        if scenario.sensors:
            self._sensors = Sensors(scenario.sensors)
            self._outputs = measured_outputs(problem, scenario.sensors)
        self.reset(0)

    def reset(self, seed: int) -> Array:
        """Start again from the scenario's initial state, with the noise of a seed; the state."""
        self._rng = np.random.default_rng(seed)
        self._s = self.scenario.initial_state
        self._k = 0
        self.y: Array | None = None
        if self._sensors is not None:
            values = self._measured()
            self.y = self._sensors.start(seed, values)
        return self._s

    def _measured(self) -> list[float]:
        """Present values of the variables that the sensors read, (n_y,)."""
        self._outputs.inputs["z"][:] = self._s
        self._outputs()
        outputs = self._outputs.part("y")
        values: list[float] = outputs.tolist()
        return values

    def step(self, a: Array) -> Step:
        """Hold the action a (m,) for one sampling time."""
        s = self._s
        function = self._function
        # In proportion to their magnitudes: nobody knows more on the first day.
        draws = self._rng.standard_normal(self._nominal.size)
        share = self._deviation * draws
        d = np.array(displaced(self._nominal, self._magnitudes, share))
        function.inputs["x"][:] = s
        function.inputs["u"][:] = a
        function.inputs["d"][:] = d
        function()
        # A copy: the next call writes into the same memory.
        self._s = function.part("y").copy()
        self._k += 1
        if self._sensors is not None:
            values = self._measured()
            self.y = self._sensors.read(self._k, values)
        stage_cost = float(function.part("l")[0])
        # A sample's penalty is that of the state in which it begins.
        penalty = self.scenario.state_penalty(s.tolist())
        return Step(self._s, stage_cost, penalty, d, self.y)


def _require_a_solution(n_solved: int, scenario: Scenario) -> None:
    """Refuse a simulation of which no sample was solved: it says nothing of any back-off."""
    if n_solved == 0:
        raise TuningError(
            f"scenario '{scenario.name}': no sample of the controller's own model was solved, so "
            "that no back-off can be found; `cosim evaluate` of `tuned` counts the failures: look "
            "at the model, its bounds and `cosim tuning` there"
        )


def _transition(sample: Sample, scenario: Scenario) -> Transition | None:
    """Quantities of a greedy sample for a search; None after a failed solve."""
    solution: Any = sample.solution
    if solution is None:
        return None
    step = sample.step
    cost = step.stage_cost + step.penalty
    next_penalty = scenario.state_penalty(step.s.tolist())
    # The search reads neither Q nor what comes after: the sample's own solution stands for both.
    return Transition(
        number=0,
        s=sample.s,
        a=sample.a,
        explored=False,
        solution=solution,
        q_solution=solution,
        stage_cost=step.stage_cost,
        cost=cost,
        known_cost=cost,
        next_s=step.s,
        next_penalty=next_penalty,
        next_solution=solution,
        point=None,
        next_point=None,
    )
