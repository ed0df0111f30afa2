"""Where learning starts: θ of the chosen parametrisation, and the controller that carries it."""

from __future__ import annotations

import numpy as np

from controllers.converged import ConvergedNmpc
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import ThetaBlocks
from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.exploration import Strategy, strategy
from learning.protocols import LearnableController
from learning.schedule import linear

CONTROLLERS = ("rti", "converged")


def starting_parameters(problem: Problem, configuration: Configuration) -> Parameters:
    """The paper's naive θ; with the extended one, the slack weights of the configuration too."""
    offset = None
    if configuration.value_offset == "discounted" and problem.discount < 1:
        offset = problem.reference_cost / (1 - problem.discount)
    extended = configuration.parametrisation == "extended"
    blocks = ThetaBlocks.of(problem, slack_weights=extended)
    parameters = Parameters.naive(problem, blocks, value_offset=offset)
    if not extended:
        return parameters
    ones = np.ones(problem.n_states)
    return parameters.replace(
        {
            "w_sigma": configuration.slack_linear_weight * ones,
            "W_sigma": configuration.slack_quadratic_weight * ones,
        }
    )


def build_controller(
    kind: str, scenario: Scenario, problem: Problem, parameters: Parameters
) -> LearnableController:
    """`rti` or `converged`; raises ConfigurationError on another kind."""
    settings = scenario.controller
    if kind == "rti":
        return RtiNmpc(problem, parameters, hessian=settings.hessian, backend=settings.backend)
    if kind == "converged":
        return ConvergedNmpc(problem, parameters, backend=settings.backend)
    raise ConfigurationError(
        f"there is no learnable controller '{kind}'; there are {', '.join(CONTROLLERS)}"
    )


def build_strategy(configuration: Configuration, scenario: Scenario, samples: int) -> Strategy:
    """Exploration of a run of `samples` samples, its schedules spread over them."""
    kind, probability = configuration.exploration, configuration.exploration_probability
    probability_end = configuration.exploration_probability_end
    deviation: tuple[float, ...] = configuration.exploration_deviation
    deviation_end = configuration.exploration_deviation_end
    if kind == "scenario":
        table = scenario.exploration
        if table.kind == "none":
            raise ConfigurationError(
                f"scenario '{scenario.name}' has no exploration; choose additive, literal or "
                "perturbed-cost"
            )
        kind, probability, deviation = table.kind, table.probability, table.standard_deviation
        probability_end = deviation_end = None
    return strategy(
        kind,
        scenario.action_lower,
        scenario.action_upper,
        linear(probability, probability_end, samples),
        linear(deviation, deviation_end, samples),
    )
