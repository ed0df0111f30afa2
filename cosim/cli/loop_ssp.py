"""The closed loop of a scenario's plant and an exported controller as an SSP."""

from __future__ import annotations

from pathlib import Path

from cosim.plant.archive import unpack
from cosim.plant.start_values import start_values
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds
from fmus.ssp import Component, Connection, write_ssp

SAMPLES = 100


def write_loop(controller: Path, scenario: Scenario, seed: int, target: Path) -> Path:
    """Write the SSP whose trajectory is that of `cosim simulate --seed` with this controller.

    The controller comes first: it acts on the state at the sample, then the plant takes the step.
    Raises BuildError where the plant is not FMI 2.0, PlantError where it does not fit the scenario.
    """
    plant = scenario.plant
    plant_seed, _ = spawn_seeds(seed)
    return write_ssp(
        target,
        "loop",
        [
            Component("controller", controller, {}),
            Component("plant", unpack(plant.fmu).path, start_values(scenario, plant_seed)),
        ],
        [
            *(Connection(("plant", name), ("controller", name)) for name in plant.states),
            *(Connection(("controller", name), ("plant", name)) for name in plant.actions),
        ],
        stop_time=SAMPLES * scenario.sampling_time,
    )
