"""What a scenario says of the stochastic plant, in terms of the controller's model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.quadrature import DisturbanceLaw
from controllers.errors import OptimumError
from controllers.problem import Problem, ScenarioLike, load_model

Vector = NDArray[np.float64]
MEND = 'name the plant\'s own model as model = "module:factory" in the table [plant]'


class StochasticScenario(ScenarioLike, Protocol):
    """The part of a scenario that tells the law of the plant (`cosim.Scenario` has it)."""

    @property
    def plant(self) -> Any:
        """The true plant."""

    @property
    def disturbance(self) -> Any:
        """The law of its disturbances."""


@dataclass(frozen=True)
class PlantProblem:
    """The control problem with the plant's own model, and what is random in it.

    `parameters` (n_p,) are the plant's physical ones.
    """

    problem: Problem
    law: DisturbanceLaw
    parameters: Vector

    def __post_init__(self) -> None:
        """Raise OptimumError where the law has not the model's disturbances."""
        model = self.problem.model
        if len(self.law.nominal) != len(model.disturbances):
            raise OptimumError(
                f"the law has {len(self.law.nominal)} disturbances, model '{model.name}' "
                f"{len(model.disturbances)}"
            )

    @classmethod
    def nominal(cls, problem: Problem, law: DisturbanceLaw) -> PlantProblem:
        """A plant that has the model's nominal parameters."""
        return cls(problem, law, problem.model.nominal_parameters)

    @classmethod
    def from_scenario(
        cls,
        scenario: StochasticScenario,
        overrides: Mapping[str, float | None] | None = None,
    ) -> PlantProblem:
        """What a scenario says of its plant; `overrides` replaces plant parameters by name.

        One that is overridden by None is left out. The plant's model is `plant.model`, where the
        scenario names one, else the controller's. Raises OptimumError where it does not fit the
        plant, ModelError where it cannot be loaded.
        """
        named = scenario.plant.model
        problem = Problem.from_scenario(scenario)
        if named is not None:
            problem = replace(problem, model=load_model(named))
        merged = {**scenario.plant.parameters, **(overrides or {})}
        given = {name: value for name, value in merged.items() if value is not None}
        return cls(problem, plant_law(scenario, problem), plant_parameters(given, problem))


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
                f"{', '.join(ours)}, the plant {', '.join(theirs)}; {MEND}"
            )
    nominal = np.array(table.nominal if len(table.nominal) else model.nominal_disturbance)
    ranges = np.array(table.ranges if len(table.ranges) else np.zeros(len(names)))
    return DisturbanceLaw(table.law, nominal, ranges)


def plant_parameters(given: Mapping[str, float], problem: Problem) -> Vector:
    """Physical parameters (n_p,): the model's nominal ones with those that the plant is given."""
    model = problem.model
    parameters = model.nominal_parameters
    known = [quantity.name for quantity in model.parameters]
    for name, value in given.items():
        if name not in known:
            raise OptimumError(
                f"the optimum needs a model of the plant: plant.parameters sets '{name}', which "
                f"model '{model.name}' does not have: give the model that parameter, {MEND}, or, "
                "where it only shapes the noise, name it in plant.mapping.ranges and set "
                "disturbance.ranges"
            )
        parameters[known.index(name)] = value
    return parameters
