"""Systems of connected FMUs as SSP 1.0 archives (System Structure and Parameterization)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import fmpy

from fmus import BuildError
from fmus.build import write_archive
from fmus.description import render

# Importers of FMI 2.0 set an enumeration through its number.
_ELEMENTS = {"Real": "Real", "Integer": "Integer", "Boolean": "Boolean", "Enumeration": "Integer"}


class Component(NamedTuple):
    """An FMU in a system: its `name` there, its file `fmu`, and `starts` of its parameters.

    A start value is a number with its FMI 2.0 type, `Real`, `Integer`, `Boolean` or `Enumeration`.
    """

    name: str
    fmu: Path
    starts: Mapping[str, tuple[str, float]]


class Connection(NamedTuple):
    """A signal from one component's output `start` to an input `end`: (component, variable)."""

    start: tuple[str, str]
    end: tuple[str, str]


def write_ssp(
    target: str | Path,
    name: str,
    components: Sequence[Component],
    connections: Sequence[Connection],
    *,
    stop_time: float,
) -> Path:
    """Write an SSP 1.0 archive of FMI 2.0 components in the order in which they shall be stepped.

    Start values go into one parameter set for each component, under ``resources/``. The bytes
    repeat. Raises BuildError where a component is not FMI 2.0 for co-simulation.
    """
    members: dict[str, bytes] = {}
    for component in components:
        members[f"resources/{component.name}.fmu"] = component.fmu.read_bytes()
        if component.starts:
            members[f"resources/{component.name}.ssv"] = _parameter_set(component).encode()
    members["SystemStructure.ssd"] = render(
        "SystemStructure.ssd",
        name=name,
        components=[(each, _connectors(each, connections)) for each in components],
        connections=connections,
        stop_time=float(stop_time),
    ).encode()
    return write_archive(members, Path(target))


def _connectors(component: Component, connections: Sequence[Connection]) -> list[tuple[str, str]]:
    """Kind and variable of a component's connectors, each once."""
    description = fmpy.read_model_description(str(component.fmu))
    if description.fmiVersion != "2.0" or description.coSimulation is None:
        raise BuildError(
            f"{component.fmu} is not an FMI 2.0 FMU for co-simulation, which SSP 1.0 asks for"
        )
    ends = [("input", c.end) for c in connections] + [("output", c.start) for c in connections]
    return list(dict.fromkeys((kind, end[1]) for kind, end in ends if end[0] == component.name))


def _parameter_set(component: Component) -> str:
    parameters = []
    for name, (kind, value) in component.starts.items():
        text = repr(float(value)) if kind == "Real" else str(int(value))
        if kind == "Boolean":
            text = "true" if value else "false"
        parameters.append((name, _ELEMENTS[kind], text))
    return render("parameters.ssv", name=component.name, parameters=parameters)
