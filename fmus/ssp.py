"""The closed loop of two connected FMUs as an SSP 1.0 archive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import fmpy
from attrs import asdict

from fmus import BuildError
from fmus.build import write_archive
from fmus.model import render

# Importers of FMI 2.0 set an enumeration through its number.
_ELEMENTS = {"Real": "Real", "Integer": "Integer", "Boolean": "Boolean", "Enumeration": "Integer"}


def write_ssp(
    target: str | Path,
    controller: Path,
    plant: Path,
    states: Sequence[str],
    actions: Sequence[str],
    starts: Mapping[str, tuple[str, float]],
    *,
    stop_time: float,
) -> Path:
    """Write a loop of two FMI 2.0 FMUs (System Structure and Parameterization); the bytes repeat.

    The controller is stepped first. `states` go from the plant to it, `actions` back, by their
    names in both and with their units; `starts` are the plant's start values with their FMI 2.0
    types, `Real`, `Integer`, `Boolean` or `Enumeration`. Raises BuildError where an FMU is not FMI
    2.0.
    """
    members = {"resources/plant.ssv": _parameter_set("plant", starts).encode()}
    components = []
    units: dict[str, dict[str, float]] = {}
    for name, fmu, inputs, outputs in (
        ("controller", controller, states, actions),
        ("plant", plant, actions, states),
    ):
        description = fmpy.read_model_description(str(fmu))
        if description.fmiVersion != "2.0" or description.coSimulation is None:
            raise BuildError(
                f"{fmu} is not an FMI 2.0 FMU for co-simulation, which SSP 1.0 asks for"
            )
        members[f"resources/{name}.fmu"] = fmu.read_bytes()
        known = {u.name: asdict(u.baseUnit) for u in description.unitDefinitions if u.baseUnit}
        unit_of = {v.name: v.unit for v in description.modelVariables if v.unit in known}
        units |= {unit: known[unit] for each in (*inputs, *outputs) if (unit := unit_of.get(each))}
        connectors = [
            (kind, each, {"unit": unit_of.get(each)})
            for kind, names in (("input", inputs), ("output", outputs))
            for each in names
        ]
        components.append(({"name": name, "starts": name == "plant"}, connectors))
    connections = [
        {"start": (one, name), "end": (other, name)}
        for one, other, names in (("plant", "controller", states), ("controller", "plant", actions))
        for name in names
    ]
    members["SystemStructure.ssd"] = render(
        "SystemStructure.ssd",
        name="loop",
        components=components,
        connections=connections,
        units=units,
        stop_time=float(stop_time),
    ).encode()
    return write_archive(members, Path(target))


def _parameter_set(component: str, starts: Mapping[str, tuple[str, float]]) -> str:
    parameters = []
    for name, (kind, value) in starts.items():
        text = repr(float(value)) if kind == "Real" else str(int(value))
        if kind == "Boolean":
            text = "true" if value else "false"
        parameters.append((name, _ELEMENTS[kind], text))
    return render("parameters.ssv", name=component, parameters=parameters)
