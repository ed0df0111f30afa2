"""What a scenario says of the stochastic plant, in terms of the controller's model."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.quadrature import DisturbanceLaw
from controllers.errors import OptimumError
from controllers.problem import Problem, ScenarioLike

Vector = NDArray[np.float64]


class StochasticScenario(ScenarioLike, Protocol):
    """The part of a scenario that tells the law of the plant (`cosim.Scenario` has it)."""

    @property
    def plant(self) -> Any:
        """The true plant."""

    @property
    def disturbance(self) -> Any:
        """The law of its disturbances."""


def plant_law(scenario: StochasticScenario, problem: Problem) -> DisturbanceLaw:
    """The scenario's disturbance law in the order of the model's disturbances."""
    table = scenario.disturbance
    model = problem.model
    names = tuple(quantity.name for quantity in model.disturbances)
    for kind, ours, theirs in (
        ("states", tuple(q.name for q in model.states), tuple(scenario.plant.states)),
        ("actions", tuple(q.name for q in model.actions), tuple(scenario.plant.actions)),
        ("disturbances", names, tuple(scenario.plant.disturbances)),
    ):
        if ours != theirs:
            raise OptimumError(
                f"the optimum needs a model of the plant: model '{model.name}' has the {kind} "
                f"{', '.join(ours)}, the plant {', '.join(theirs)}"
            )
    nominal = np.array(table.nominal if len(table.nominal) else model.nominal_disturbance)
    ranges = np.array(table.ranges if len(table.ranges) else np.zeros(len(names)))
    return DisturbanceLaw(table.law, nominal, ranges)


def plant_parameters(scenario: StochasticScenario, problem: Problem) -> Vector:
    """Physical parameters (n_p,): the model's nominal ones with what the scenario's plant sets."""
    model = problem.model
    parameters = model.nominal_parameters
    for name, value in scenario.plant.parameters.items():
        known = [quantity.name for quantity in model.parameters]
        if name not in known:
            raise OptimumError(
                f"the optimum needs a model of the plant: plant.parameters sets '{name}', which "
                f"model '{model.name}' does not have: give the model that parameter, or, where it "
                "only shapes the noise, name it in plant.mapping.ranges and set disturbance.ranges"
            )
        parameters[known.index(name)] = value
    return parameters
