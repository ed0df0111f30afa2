"""The closed loop of a scenario's plant and an exported controller as an SSP."""

from __future__ import annotations

from pathlib import Path

from cosim.plant.archive import unpack
from cosim.plant.wiring import start_values
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds
from fmus.ssp import Component, Connection, write_ssp

SAMPLES = 100
SATURATE = "saturate"


def write_loop(controller: Path, scenario: Scenario, seed: int, target: Path) -> Path:
    """Write the SSP whose trajectory is that of `cosim simulate --seed` with this controller.

    The controller comes first: it acts on the state at the sample, then the plant takes the step.
    Where the plant can, its inputs saturate, as the loop of `simulate` does it, so that a master
    may begin before any action has come.
    Raises BuildError where the plant is not FMI 2.0, PlantError where it does not fit the scenario.
    """
    plant = scenario.plant
    plant_seed, _ = spawn_seeds(seed)
    starts = start_values(scenario, plant_seed)
    archive = unpack(plant.fmu)
    types = {variable.name: variable.type for variable in archive.description.modelVariables}
    if SATURATE in types:
        starts[SATURATE] = ("Boolean", 1.0)
    for name, (kind, value) in list(starts.items()):
        # libcosim ignores enumerations of FMI 2.0; our plants have an integer beside theirs.
        if kind == "Enumeration" and types.get(f"{name}_number") == "Integer":
            del starts[name]
            starts[f"{name}_number"] = ("Integer", value)
    return write_ssp(
        target,
        "loop",
        [
            Component("controller", controller, {}),
            Component("plant", archive.path, starts),
        ],
        [
            *(Connection(("plant", name), ("controller", name)) for name in plant.states),
            *(Connection(("controller", name), ("plant", name)) for name in plant.actions),
        ],
        stop_time=SAMPLES * scenario.sampling_time,
    )
