"""Where learning starts: θ of the chosen parametrisation, and the controller that carries it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.economic import tune
from controllers.factories import nmpc
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.theta import ThetaBlocks
from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.exploration import Strategy, strategy
from learning.protocols import LearnableController
from learning.schedule import linear

Vector = NDArray[np.float64]
CONTROLLERS = ("rti", "converged")


def starting_parameters(
    problem: Problem, configuration: Configuration, start: str = "naive"
) -> Parameters:
    """θ at the start: the paper's naive one, the economically tuned one, or that of a file.

    `start` is `naive`, `tuned` or the path of a parameters file. `naive` and `tuned` take c_lambda
    and, with the extended θ, the slack weights from the configuration; blocks that a file has
    stand as they are, those of the configuration's parametrisation that it lacks start as with
    `naive`. Raises ConfigurationError where the file has slack weights and the parametrisation
    none, ParameterError on a bad file, TuningError where the tuning fails.
    """
    blocks = ThetaBlocks.of(
        problem,
        slack_weights=configuration.parametrisation == "extended",
        model_parameters=configuration.learned_parameters(problem.model),
    )
    offset = _value_offset(problem, configuration)
    naive = Parameters.naive(problem, blocks, value_offset=offset)
    if start == "naive":
        return naive.replace(_slack_weights(blocks, configuration))
    if start == "tuned":
        tuned = tune(problem, blocks, value_offset=offset).parameters
        return tuned.replace(_slack_weights(blocks, configuration))
    return _extended(problem, configuration, start)


def _value_offset(problem: Problem, configuration: Configuration) -> float | None:
    """c_lambda at the start, None for ℓ_s; the level of V is that of the TD error's discount."""
    chosen: float | None = getattr(configuration, "discount", None)
    return problem.value_level(chosen) if configuration.value_offset == "discounted" else None


def _slack_weights(blocks: ThetaBlocks, configuration: Configuration) -> dict[str, Vector]:
    """The slack weights at the start by block, none for the paper's θ."""
    chosen = {
        "w_sigma": configuration.slack_linear_weight,
        "W_sigma": configuration.slack_quadratic_weight,
    }
    return {
        name: blocks.scale[blocks.slices[name]]
        if weight is None
        else np.full(blocks.block(name).size, weight)
        for name, weight in chosen.items()
        if name in blocks
    }


def _extended(problem: Problem, configuration: Configuration, path: str) -> Parameters:
    """θ of a file, with the blocks that it lacks."""
    found = Parameters.load(path, problem)
    learned = "w_sigma" in found.blocks
    if learned and configuration.parametrisation == "paper":
        raise ConfigurationError(
            f"{path}: θ has slack weights, which the parametrisation 'paper' has not; set "
            "parametrisation=extended"
        )
    names = found.blocks.block("p").labels if "p" in found.blocks else ()
    more = tuple(
        name for name in configuration.learned_parameters(problem.model) if name not in names
    )
    blocks = ThetaBlocks.of(
        problem,
        slack_weights=configuration.parametrisation == "extended",
        model_parameters=(*names, *more),
    )
    values: dict[str, ArrayLike] = {block.name: found[block.name] for block in found.blocks}
    if not learned:
        values |= _slack_weights(blocks, configuration)
    if more:
        chosen = problem.model.parameter_indices(more)
        nominal = problem.model.nominal_parameters[chosen]
        values["p"] = np.concatenate([values.get("p", np.empty(0)), nominal])
    return Parameters.naive(problem, blocks).replace(values)


def build_controller(kind: str, scenario: Scenario, parameters: Parameters) -> LearnableController:
    """`rti` or `converged`; raises ConfigurationError on another kind."""
    if kind not in CONTROLLERS:
        raise ConfigurationError(
            f"there is no learnable controller '{kind}'; there are {', '.join(CONTROLLERS)}"
        )
    return nmpc(scenario, parameters, kind)


def build_strategy(configuration: Configuration, scenario: Scenario, samples: int) -> Strategy:
    """Exploration of a run of `samples` samples, its schedules spread over them."""
    kind, probability = configuration.exploration, configuration.exploration_probability
    probability_end = configuration.exploration_probability_end
    deviation = configuration.deviation(scenario)
    deviation_end = configuration.exploration_deviation_end
    if kind == "none":
        kind, probability, probability_end = "additive", 0.0, None
    return strategy(
        kind,
        scenario.action_lower,
        scenario.action_upper,
        linear(probability, probability_end, samples),
        linear(deviation, deviation_end, samples),
    )
