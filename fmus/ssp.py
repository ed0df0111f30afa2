"""The closed loop of two connected FMUs as an SSP archive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import fmpy
from fmpy.model_description import ModelDescription

from fmus import BuildError
from fmus.build import write_archive
from fmus.model import render

BASE_UNIT = ("kg", "m", "s", "A", "K", "mol", "cd", "rad", "factor", "offset")
"""Attributes of FMI's BaseUnit."""


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
    """Write a loop of two FMUs (System Structure and Parameterization); the bytes repeat.

    It is SSP 1.0 where both are FMI 2.0, else SSP 2.0, which has FMI 3.0's types. The controller is
    stepped first. `states`, and the disturbances that it measures, go from the plant to it,
    `actions` back, by their names in both and with their units; `starts` are the plant's start
    values with their FMI types. Raises BuildError where an FMU has no co-simulation.
    """
    members: dict[str, bytes] = {}
    components = []
    versions = set()
    units: dict[str, dict[str, float]] = {}
    for name, fmu, inputs, outputs in (
        ("controller", controller, states, actions),
        ("plant", plant, actions, states),
    ):
        description = fmpy.read_model_description(str(fmu))
        if description.coSimulation is None:
            raise BuildError(f"{fmu} has no co-simulation interface")
        versions.add(description.fmiVersion[0])
        members[f"resources/{name}.fmu"] = fmu.read_bytes()
        known = {
            unit.name: {name: getattr(unit.baseUnit, name) for name in BASE_UNIT}
            for unit in description.unitDefinitions
            if unit.baseUnit
        }
        unit_of = {v.name: v.unit for v in description.modelVariables if v.unit in known}
        units |= {unit: known[unit] for each in (*inputs, *outputs) if (unit := unit_of.get(each))}
        connectors = [
            (kind, each, {"unit": unit_of.get(each)})
            for kind, names in (("input", inputs), ("output", outputs))
            for each in names
        ]
        real = "Real" if description.fmiVersion[0] == "2" else "Float64"
        about = {"name": name, "starts": name == "plant", "real": real}
        components.append((about, connectors))
    connections = [
        {"start": (one, name), "end": (other, name)}
        for one, other, names in (("plant", "controller", states), ("controller", "plant", actions))
        for name in names
    ]
    ssp = "1.0" if versions == {"2"} else "2.0"
    parameters = _parameters(description, starts)
    members["resources/plant.ssv"] = render(
        "parameters.ssv", version=ssp, name="plant", parameters=parameters
    ).encode()
    members["SystemStructure.ssd"] = render(
        "SystemStructure.ssd",
        version=ssp,
        name="loop",
        components=components,
        connections=connections,
        units=units,
        stop_time=float(stop_time),
    ).encode()
    return write_archive(members, Path(target))


def _parameters(
    plant: ModelDescription, starts: Mapping[str, tuple[str, float]]
) -> list[tuple[str, str, str]]:
    """Name, element and text of each start value."""
    types = {variable.name: variable.declaredType for variable in plant.modelVariables}
    parameters = []
    for name, (stated, value) in starts.items():
        # Importers of FMI 2.0 set an enumeration through its number.
        number = stated == "Enumeration" and plant.fmiVersion[0] == "2"
        kind = "Integer" if number else stated
        text = repr(float(value)) if kind in ("Real", "Float64", "Float32") else str(int(value))
        if kind == "Boolean":
            text = "true" if value else "false"
        elif kind == "Enumeration":
            text = next(item.name for item in types[name].items if item.value == text)
        parameters.append((name, kind, text))
    return parameters
