"""J* of a scenario's plant, where it is known."""

from __future__ import annotations

from controllers.yardstick import yardstick
from cosim.plant.archive import SHIPPED
from cosim.scenario import Scenario

OPTIMAL = "optimal"


def stored_optimum(scenario: Scenario) -> str | None:
    """`optimal` where it is the scenario's yardstick and can be had without solving anything.

    A foreign FMU may be another plant than the controller's model, whose optimum it is, unless the
    scenario names the plant's own model.
    """
    if scenario.plant.fmu not in SHIPPED and scenario.plant.model is None:
        return None
    return None if yardstick(scenario) is None else OPTIMAL
