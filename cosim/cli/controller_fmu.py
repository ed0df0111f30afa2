"""The controller's C and its variables, put into an FMU."""

from __future__ import annotations

import hashlib
import json
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from controllers import RtiNmpc
from controllers.export import STATUSES, core, plain_c
from cosim.errors import ControllerLookupError
from cosim.files import write_atomically
from cosim.plant.archive import unpack
from cosim.plant.wiring import start_values
from cosim.plugins import build_controller
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds
from fmus.build import PROCESSORS, footprint
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
    if type(found) is not RtiNmpc or found.iterations != 1:
        raise ControllerLookupError(
            f"controller '{name}' is no RTI-NMPC and cannot be exported; give "
            "naive, tuned or a parameters file (.toml) of a training"
        )
    return found


def sampled_controller(
    controller: RtiNmpc, scenario: Scenario, units: dict[str, str]
) -> SampledSystem:
    """The controller as a sampled system; raises ControllerError where it cannot be exported.

    `units` are those of the plant's variables by name.
    """
    hessian = scenario.controller.hessian
    origin = f"{scenario.hash} {hessian} {controller.parameters.hash}"
    problem, parameters = controller.problem, controller.parameters
    exported, blocks = core(problem, parameters, hessian), parameters.blocks
    states = [(name, units.get(name, "")) for name in scenario.plant.states]
    actions = [(name, units.get(name, "")) for name in scenario.plant.actions]
    predicted = [(states, k) for k in range(problem.horizon + 1)]
    predicted += [(actions, k) for k in range(problem.horizon)]
    bounds = zip(problem.action_lower.tolist(), problem.action_upper.tolist(), strict=True)
    codes = ", ".join(f"{code} {text}" for code, text in enumerate(STATUSES))
    return SampledSystem(
        name=f"RTI-NMPC {scenario.name}",
        identifier=f"rti_nmpc_{hashlib.sha256(origin.encode()).hexdigest()[:12]}",
        description=(
            f"Real-time-iteration NMPC for {scenario.name}: horizon {problem.horizon}, "
            f"{hessian} Hessian, θ {parameters.hash}"
        ),
        sampling_time=scenario.sampling_time,
        inputs=tuple(
            Signal(name, unit, "measured state", start)
            for (name, unit), start in zip(states, problem.reference_state.tolist(), strict=True)
        ),
        outputs=(
            *(
                Signal(name, unit, "action, within its bounds", None, low, high)
                for (name, unit), (low, high) in zip(actions, bounds, strict=True)
            ),
            Signal("value", "", "value V(s) of the state"),
            Signal("qp_status", "", f"of the present sample: {codes}"),
            Signal("kkt_residual", "", "largest KKT residual of the last QP that was solved"),
            Signal("qp_iterations", "", "steps of the QP solver in the last QP that was solved"),
            Signal(
                "failures", "", "samples without a solution so far; they repeat the last action"
            ),
            *(
                Signal(f"predicted.{name}[{k}]", unit, f"predicted {name}, {k} samples ahead")
                for quantities, k in predicted
                for name, unit in quantities
            ),
        ),
        parameters=tuple(
            Signal(f"theta.{_structured(label)}", "", meaning, value)
            for label, meaning, value in zip(
                blocks.labels,
                (block.meaning for block in blocks for _ in range(block.size)),
                parameters.theta.tolist(),
                strict=True,
            )
        ),
        sources=exported.sources,
    )


def write_c(controller: RtiNmpc, scenario: Scenario, folder: Path) -> dict[str, Any]:
    """Write the controller as C into `folder`, whose name its functions begin with.

    Returns a summary with the bytes that it takes on `PROCESSORS`, none without a cross-compiler.
    """
    exported = core(controller.problem, controller.parameters, scenario.controller.hessian)
    name = re.sub(r"\W", "_", folder.absolute().name)
    files = plain_c(exported, name, scenario)
    folder.mkdir(exist_ok=True)
    for file, text in files.items():
        write_atomically(folder / file, text)
    measured = {}
    if find_spec("ziglang") is not None:
        code = {file: files[file].encode() for file in (f"{name}.c", f"{name}.h")}
        memory = sum(map(int, re.findall(r"_(?:MEMORY|THETA) = (\d+)", files[f"{name}.h"])))
        for processor, target in PROCESSORS.items():
            measured[processor] = footprint(code, target) | {"instance": 8 * memory}
    return {"folder": str(folder), "files": list(files), "name": name, "bytes": measured}


def _structured(label: str) -> str:
    """A label of θ as FMI's structured names have it: `p[UA2]` becomes `p.UA2`."""
    block, bracket, rest = label.partition("[")
    inner = rest.removesuffix("]")
    return label if not bracket or inner.replace(",", "").isdigit() else f"{block}.{inner}"


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
