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
    stepped first.

    Args:
        target: path of the archive.
        controller: path of the controller's FMU.
        plant: path of the plant's FMU.
        states: what goes from the plant to the controller, measured disturbances too; the names are
            those of both, with their units.
        actions: what goes back, likewise.
        starts: start values of the plant by name, each with its FMI type.
        stop_time: of the default experiment, in s.

    Returns:
        The path of the archive.

    Raises:
        BuildError: if an FMU has no co-simulation.
    """
    # What one gives the other takes.
    ends = {
        "controller": (controller, states, actions),
        "plant": (plant, actions, states),
    }
    components = []
    versions = set()
    units: dict[str, dict[str, float]] = {}
    members: dict[str, bytes] = {}
    for name, (fmu, inputs, outputs) in ends.items():
        description = fmpy.read_model_description(str(fmu))
        if description.coSimulation is None:
            raise BuildError(f"{fmu} has no co-simulation interface")
        version = description.fmiVersion[0]
        versions.add(version)
        members[f"resources/{name}.fmu"] = fmu.read_bytes()
        known = _base_units(description)
        # SSP describes each unit that a connector names.
        unit_of = {}
        for variable in description.modelVariables:
            if variable.unit in known:
                unit_of[variable.name] = variable.unit
        connectors = []
        for kind, names in (("input", inputs), ("output", outputs)):
            for signal in names:
                unit = unit_of.get(signal)
                if unit is not None:
                    units[unit] = known[unit]
                connectors.append((kind, signal, {"unit": unit}))
        component = {
            "name": name,
            "starts": name == "plant",
            "real": "Real" if version == "2" else "Float64",
        }
        components.append((component, connectors))
    connections = []
    for signal in states:
        connections.append(_connection("plant", "controller", signal))
    for signal in actions:
        connections.append(_connection("controller", "plant", signal))
    ssp = "1.0" if versions == {"2"} else "2.0"
    plant_description = fmpy.read_model_description(str(plant))
    parameters = render(
        "parameters.ssv",
        version=ssp,
        name="plant",
        parameters=_parameters(plant_description, starts),
    )
    structure = render(
        "SystemStructure.ssd",
        version=ssp,
        name="loop",
        components=components,
        connections=connections,
        units=units,
        stop_time=float(stop_time),
    )
    members["resources/plant.ssv"] = parameters.encode()
    members["SystemStructure.ssd"] = structure.encode()
    return write_archive(members, Path(target))


def _base_units(description: ModelDescription) -> dict[str, dict[str, float]]:
    """The attributes of BaseUnit of each unit that has one, by the unit's name."""
    units = {}
    for unit in description.unitDefinitions:
        # A unit may be stated by its name alone.
        if unit.baseUnit:
            units[unit.name] = {key: getattr(unit.baseUnit, key) for key in BASE_UNIT}
    return units


def _connection(
    source: str,
    sink: str,
    signal: str,
) -> dict[str, tuple[str, str]]:
    """A connection of two components' connectors of one name."""
    return {"start": (source, signal), "end": (sink, signal)}


def _parameters(
    plant: ModelDescription,
    starts: Mapping[str, tuple[str, float]],
) -> list[tuple[str, str, str]]:
    """Name, element and text of each start value."""
    types = {}
    for variable in plant.modelVariables:
        types[variable.name] = variable.declaredType
    parameters = []
    for name, (kind, value) in starts.items():
        # Importers of FMI 2.0 set an enumeration through its number.
        if kind == "Enumeration" and plant.fmiVersion[0] == "2":
            kind = "Integer"  # noqa: PLW2901
        if kind in ("Real", "Float64", "Float32"):
            text = repr(float(value))
        elif kind == "Boolean":
            text = "true" if value else "false"
        elif kind == "Enumeration":
            # SSP names the item.
            names = {item.value: item.name for item in types[name].items}
            text = names[str(int(value))]
        else:
            text = str(int(value))
        parameters.append((name, kind, text))
    return parameters
