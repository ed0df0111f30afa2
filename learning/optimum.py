"""J* of a scenario's plant, where it is known."""

from __future__ import annotations

from controllers.optimum import OptimalPolicy
from cosim.plant.archive import SHIPPED
from cosim.scenario import Scenario


def has_stored_optimum(scenario: Scenario) -> bool:
    """Whether `optimal` is J* of the scenario's plant and can be had without solving anything.

    A foreign FMU may be another plant than the controller's model, whose optimum it is.
    """
    if scenario.plant.fmu not in SHIPPED:
        return False
    return OptimalPolicy.stored(scenario) is not None
