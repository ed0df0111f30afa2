"""Systems of connected FMUs as SSP 1.0 archives (System Structure and Parameterization)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import fmpy

from fmus import BuildError
from fmus.build import write_archive
from fmus.description import to_text

_SPACES = {
    "ssc": "http://ssp-standard.org/SSP1/SystemStructureCommon",
    "ssd": "http://ssp-standard.org/SSP1/SystemStructureDescription",
    "ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues",
}
_TYPES = ("Real", "Integer", "Boolean", "Enumeration", "String")


@dataclass(frozen=True)
class Component:
    """An FMU in a system: its `name` there, its file `fmu`, and `starts` of its parameters.

    A start value is a number with its FMI 2.0 type, `Real`, `Integer`, `Boolean` or `Enumeration`.
    """

    name: str
    fmu: Path
    starts: Mapping[str, tuple[str, float]]


@dataclass(frozen=True)
class Connection:
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
    repeat. Raises BuildError where a component is not FMI 2.0 or lacks a connected variable.
    """
    known = {component.name: _variables(component) for component in components}
    root = ElementTree.Element(_tag("ssd", "SystemStructureDescription"), name=name, version="1.0")
    system = ElementTree.SubElement(root, _tag("ssd", "System"), name=name)
    elements = ElementTree.SubElement(system, _tag("ssd", "Elements"))
    members: dict[str, bytes] = {}
    for component in components:
        element = ElementTree.SubElement(
            elements,
            _tag("ssd", "Component"),
            name=component.name,
            type="application/x-fmu-sharedlibrary",
            source=f"resources/{component.name}.fmu",
        )
        members[f"resources/{component.name}.fmu"] = component.fmu.read_bytes()
        connectors = ElementTree.SubElement(element, _tag("ssd", "Connectors"))
        for kind, variable in _connected(component.name, connections):
            if variable not in known[component.name]:
                raise BuildError(f"{component.fmu} has no variable '{variable}' to connect")
            connector = ElementTree.SubElement(
                connectors, _tag("ssd", "Connector"), name=variable, kind=kind
            )
            ElementTree.SubElement(connector, _tag("ssc", "Real"))
        if component.starts:
            source = f"resources/{component.name}.ssv"
            bindings = ElementTree.SubElement(element, _tag("ssd", "ParameterBindings"))
            ElementTree.SubElement(bindings, _tag("ssd", "ParameterBinding"), source=source)
            members[source] = _parameter_set(component).encode()
    lines = ElementTree.SubElement(system, _tag("ssd", "Connections"))
    for connection in connections:
        (start, output), (end, input_) = connection.start, connection.end
        ElementTree.SubElement(
            lines,
            _tag("ssd", "Connection"),
            startElement=start,
            startConnector=output,
            endElement=end,
            endConnector=input_,
        )
    ElementTree.SubElement(
        root, _tag("ssd", "DefaultExperiment"), startTime="0.0", stopTime=repr(float(stop_time))
    )
    members["SystemStructure.ssd"] = _document(root, "ssc", "ssd").encode()
    return write_archive(members, Path(target))


def _variables(component: Component) -> set[str]:
    description = fmpy.read_model_description(str(component.fmu))
    if description.fmiVersion != "2.0" or description.coSimulation is None:
        raise BuildError(
            f"{component.fmu} is not an FMI 2.0 FMU for co-simulation, which SSP 1.0 asks for"
        )
    return {variable.name for variable in description.modelVariables}


def _connected(name: str, connections: Sequence[Connection]) -> list[tuple[str, str]]:
    """Kind and variable of a component's connectors, each once."""
    ends = [("input", c.end) for c in connections] + [("output", c.start) for c in connections]
    return list(dict.fromkeys((kind, end[1]) for kind, end in ends if end[0] == name))


def _parameter_set(component: Component) -> str:
    root = ElementTree.Element(_tag("ssv", "ParameterSet"), version="1.0", name=component.name)
    parameters = ElementTree.SubElement(root, _tag("ssv", "Parameters"))
    for name, (kind, value) in component.starts.items():
        if kind not in _TYPES:
            raise BuildError(f"{component.name}.{name}: no start value of type {kind} in an SSP")
        parameter = ElementTree.SubElement(parameters, _tag("ssv", "Parameter"), name=name)
        text = repr(float(value)) if kind == "Real" else str(int(value))
        if kind == "Boolean":
            text = "true" if value else "false"
        # Importers of FMI 2.0 set an enumeration through its number.
        tag = "Integer" if kind == "Enumeration" else kind
        ElementTree.SubElement(parameter, _tag("ssv", tag), value=text)
    return _document(root, "ssv")


def _tag(space: str, name: str) -> str:
    return f"{{{_SPACES[space]}}}{name}"


def _document(root: ElementTree.Element, *spaces: str) -> str:
    for space in spaces:
        ElementTree.register_namespace(space, _SPACES[space])
    return to_text(root)
