"""Whether the optimum of a scenario is at hand, for those who compare with it unasked."""

from __future__ import annotations

from controllers.dynamic_programming import Settings
from controllers.errors import ModelError, OptimumError
from controllers.optimum import change_of, optimum_key, stored_file
from controllers.periodic_optimum import periodic_is_stored
from controllers.problem import PlantProblem
from cosim.core.scenario import Scenario, is_file


def stored_optimum(scenario: Scenario) -> str | None:
    """`optimal` where that is the plant's optimum and all of it is shipped or cached, else None.

    A foreign FMU may be another plant than the controller's model, whose optimum it is, unless the
    scenario names the plant's own model.
    """
    # Nobody knows which plant a foreign FMU is.
    plant_is_known = scenario.plant.model is not None
    if is_file(scenario.plant.fmu) and not plant_is_known:
        return None
    if scenario.signals:
        return "optimal" if periodic_is_stored(scenario) else None
    change = change_of(scenario)
    # An optimum that is not stored would be solved for minutes: nobody has asked for that.
    plants = change.plants if change else [scenario]
    for plant in plants:
        try:
            problem = PlantProblem.from_scenario(plant)
        except (ModelError, OptimumError):
            return None
        # No controller is told what this policy needs.
        if problem.memory is not None:
            return None
        key = optimum_key(problem, Settings())
        if stored_file(key) is None:
            return None
    return "optimal"
