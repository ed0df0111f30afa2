"""The model description of a sampled system, FMI 2.0 and 3.0: co-simulation only."""

from __future__ import annotations

from xml.etree import ElementTree

from fmus.description import (
    LICENSE,
    add_categories,
    add_units,
    common_attributes,
    real_attributes,
    to_text,
)
from fmus.sampled.system import SampledSystem
from fmus.variables import FmiVersion, Kind, Variable

SAMPLES = 100


def sampled_description(system: SampledSystem, version: FmiVersion, token: str) -> str:
    """The text of modelDescription.xml with the GUID or instantiation `token`."""
    key = "guid" if version == 2 else "instantiationToken"
    root = ElementTree.Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{version}.0",
            "modelName": system.name,
            key: token,
            "description": system.description,
            "license": LICENSE,
            "generationTool": "rti-cosim",
            "variableNamingConvention": "structured",
        },
    )
    _interface(root, system, version)
    add_units(root, system.units)
    add_categories(root)
    step = repr(float(system.sampling_time))
    stop = repr(SAMPLES * float(system.sampling_time))
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stopTime=stop, stepSize=step)
    variables = ElementTree.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(system.variables):
        (_variable2 if version == 2 else _variable3)(variables, variable, reference)
    _structure(root, system, version)
    return to_text(root)


def _interface(root: ElementTree.Element, system: SampledSystem, version: FmiVersion) -> None:
    state = "FMUstate" if version == 2 else "FMUState"
    attributes = {
        "modelIdentifier": system.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
        f"canGetAndSet{state}": "true",
        f"canSerialize{state}": "true",
        "canHandleVariableCommunicationStepSize": "false",
    }
    if version == 2:
        attributes["canNotUseMemoryManagementFunctions"] = "true"
    element = ElementTree.SubElement(root, "CoSimulation", attributes)
    if version == 2:
        files = ElementTree.SubElement(element, "SourceFiles")
        ElementTree.SubElement(files, "File", name="fmi2.c")


def _variable2(parent: ElementTree.Element, variable: Variable, reference: int) -> None:
    if variable.kind is Kind.INDEPENDENT:
        return
    attributes = common_attributes(variable, reference)
    if variable.kind is Kind.OUTPUT:
        attributes["variability"] = "discrete"
    scalar = ElementTree.SubElement(parent, "ScalarVariable", attributes)
    ElementTree.SubElement(scalar, "Real", _numbers(variable))


def _variable3(parent: ElementTree.Element, variable: Variable, reference: int) -> None:
    attributes = common_attributes(variable, reference) | _numbers(variable)
    if variable.kind is Kind.OUTPUT:
        attributes["variability"] = "discrete"
    ElementTree.SubElement(parent, "Float64", attributes)


def _numbers(variable: Variable) -> dict[str, str]:
    attributes = real_attributes(variable)
    if not attributes["unit"]:
        del attributes["unit"]
    return attributes


def _structure(root: ElementTree.Element, system: SampledSystem, version: FmiVersion) -> None:
    """Every output follows every input at once, and at the start every parameter too."""
    structure = ElementTree.SubElement(root, "ModelStructure")

    def numbers(kind: Kind) -> list[str]:
        # FMI 2.0 counts the variables shown, from 1, and shows no time: they are the references.
        return [str(i) for i, variable in enumerate(system.variables) if variable.kind is kind]

    inputs, parameters = numbers(Kind.INPUT), numbers(Kind.TUNABLE)
    for tag, group, known in (
        ("Output", "Outputs", inputs),
        ("InitialUnknown", "InitialUnknowns", inputs + parameters),
    ):
        parent = structure if version == 3 else ElementTree.SubElement(structure, group)
        for reference in numbers(Kind.OUTPUT):
            ElementTree.SubElement(
                parent,
                tag if version == 3 else "Unknown",
                {
                    "valueReference" if version == 3 else "index": reference,
                    "dependencies": " ".join(known),
                    "dependenciesKind": " ".join("dependent" for _ in known),
                },
            )
