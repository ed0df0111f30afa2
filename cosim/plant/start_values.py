"""The start values that a scenario gives its plant, by name: what another tool must set."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.plant.archive import unpack
from cosim.plant.fmi2 import Fmi2Instance
from cosim.plant.wiring import Wirer, seed_words

if TYPE_CHECKING:
    from cosim.scenario import Scenario


def start_values(scenario: Scenario, plant_seed: int) -> dict[str, tuple[str, float]]:
    """FMI 2.0 type and value of each parameter that differs by scenario, the seed's words too.

    `plant_seed` is the first of `cosim.simulation.spawn_seeds`. Raises PlantError where the
    scenario's FMU does not fit it.
    """
    fmu = unpack(scenario.plant.fmu)
    wirer = Wirer(scenario, fmu, Fmi2Instance)
    names = {
        (int(variable.valueReference), variable.type): variable.name
        for variable in fmu.description.modelVariables
    }
    found = {
        names[start.reference, start.type]: (start.type, start.value)
        for start in wirer.wiring().starts
    }
    for kind, reference, value in seed_words(plant_seed, wirer.seeds()):
        found[names[reference, kind]] = (kind, value)
    return found
