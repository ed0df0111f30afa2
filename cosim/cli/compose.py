"""Builds plants as the command line does: foreign native code is announced before it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lookup import import_from_here

if TYPE_CHECKING:
    from cosim.cli.output import Output
    from cosim.plant import FmuPlant
    from cosim.scenario import Scenario


def build_plant(scenario: Scenario, output: Output | None = None) -> FmuPlant:
    """Build the scenario's plant, announced on `output` if it is foreign; raises PlantError."""
    from cosim.plant import FmuPlant

    import_from_here()
    if output is not None:
        announce(scenario, output)
    return FmuPlant(scenario)


def announce(scenario: Scenario, output: Output) -> None:
    """Say which native code is about to run, unless it is the package's own."""
    from cosim.plant.archive import SHIPPED, unpack

    if scenario.plant.fmu not in SHIPPED:
        fmu = unpack(scenario.plant.fmu)
        output.note(f"native code of {fmu.path}, sha256 {fmu.sha256}")
