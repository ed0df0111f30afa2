"""The controller's C and its table of variables, put into an FMU; the loop put into an SSP."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from controllers import RtiNmpc
from controllers.export import Entry, core, table
from cosim.errors import ControllerLookupError
from cosim.plant.archive import unpack
from cosim.plant.wiring import start_values
from cosim.plugins import build_controller
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds
from fmus.model import FmiVersion
from fmus.sampled import SampledSystem, Signal, build_sampled
from fmus.ssp import Component, Connection, write_ssp

SAMPLES = 100
"""Default length of the SSP's experiment."""
SATURATE = "saturate"
RECORD = "extra/org.rti-cosim/controller.json"


def rti_controller(name: str, scenario: Scenario) -> RtiNmpc:
    """The controller `name`; raises ControllerLookupError where it is no RTI-NMPC."""
    found: Any = build_controller(name, scenario)
    if type(found) is not RtiNmpc:
        raise ControllerLookupError(
            f"controller '{name}' is no RTI-NMPC and cannot be exported; give naive, tuned or a "
            "parameters file (.toml) of a training"
        )
    return found


def sampled_controller(
    controller: RtiNmpc, scenario: Scenario, units: dict[str, str]
) -> SampledSystem:
    """The controller as a sampled system; raises ControllerError where it cannot be exported."""
    hessian = scenario.controller.hessian
    origin = f"{scenario.hash} {hessian} {controller.parameters.hash}"
    exported = core(controller.problem, controller.parameters, hessian)
    plant = scenario.plant
    variables = table(
        exported,
        [(name, units.get(name, "")) for name in plant.states],
        [(name, units.get(name, "")) for name in plant.actions],
    )
    return SampledSystem(
        name=f"RTI-NMPC {scenario.name}",
        identifier=f"rti_nmpc_{hashlib.sha256(origin.encode()).hexdigest()[:12]}",
        description=(
            f"Real-time-iteration NMPC for {scenario.name}: horizon {exported.problem.horizon}, "
            f"{hessian} Hessian, θ {controller.parameters.hash}"
        ),
        sampling_time=scenario.sampling_time,
        inputs=tuple(map(_signal, variables.inputs)),
        outputs=tuple(map(_signal, variables.outputs)),
        parameters=tuple(map(_signal, variables.parameters)),
        sources=exported.sources,
    )


def _signal(entry: Entry) -> Signal:
    return Signal(entry.name, entry.unit, entry.meaning, entry.start, entry.lower, entry.upper)


def write_fmu(
    system: SampledSystem,
    controller: RtiNmpc,
    scenario: Scenario,
    target: Path,
    version: FmiVersion,
    every_platform: bool,
) -> Path:
    """Write the FMU with a record of what it was made from."""
    record = {
        "scenario": scenario.to_dict(),
        "scenario_hash": scenario.hash,
        "theta": dict(
            zip(controller.parameters.blocks.labels, controller.theta.tolist(), strict=True)
        ),
        "theta_hash": controller.parameters.hash,
    }
    document = (json.dumps(record, indent=2, default=repr) + "\n").encode()
    return build_sampled(
        system, target, version, every_platform=every_platform, files={RECORD: document}
    )


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
