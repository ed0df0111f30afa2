"""Builds plants as the command line does: foreign native code is announced before it runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cosim.plugins import import_from

LONG = 200
"""Stages of a horizon above which building a controller takes seconds."""
MEASURED = "(1000 stages: 25 s of CPU, 1.4 GB)"

if TYPE_CHECKING:
    from cosim.cli.output import Output
    from cosim.plant import FmuPlant
    from cosim.scenario import Scenario


def load_scenario(name: str) -> Scenario:
    """Load a preset or TOML file, so that its `module:function` may lie beside it or here.

    Raises ScenarioError.
    """
    from cosim.scenario import Scenario

    if Path(name).is_file():
        import_from(Path(name).resolve().parent)
    return Scenario.load(name)


def build_plant(scenario: Scenario, output: Output | None = None) -> FmuPlant:
    """Build the scenario's plant, announced on `output` if it is foreign; raises PlantError."""
    from cosim.plant import FmuPlant

    if output is not None:
        announce(scenario, output)
    return FmuPlant(scenario)


def announce(scenario: Scenario, output: Output) -> None:
    """Say which native code is about to run, unless it is the package's own, and watch it.

    Say, too, what a long horizon means for whoever waits.
    """
    announce_fmu(scenario.plant.fmu, output)
    if (stages := scenario.controller.horizon) > LONG:
        output.note(f"horizon {stages}: building the controller takes its time {MEASURED}")


def announce_fmu(name: str, output: Output) -> None:
    """Do the same for an FMU by its path, or a shipped one's name."""
    from cosim.plant.archive import SHIPPED, unpack
    from cosim.processes import watch

    if name not in SHIPPED:
        fmu = unpack(name)
        watch(fmu.path, output.stdout)
        output.note(f"native code of {fmu.path}, sha256 {fmu.sha256}")
