"""An FMU's generated texts: model description (FMI 2.0, 3.0), build description, C header."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from importlib.metadata import version as version_of
from xml.etree import ElementTree

from fmus.model import (
    LAWS,
    FmiVersion,
    Kind,
    Model,
    Type,
    Unit,
    Variable,
    continuous_dependencies,
    initial_dependencies,
)

LICENSE = "MIT"

_LOG_CATEGORIES = {
    "logEvents": "events",
    "logStatusWarning": "warnings",
    "logStatusDiscard": "calls that were discarded, and why",
    "logStatusError": "calls that were refused, and why",
}
_CAUSALITY = {
    Kind.INDEPENDENT: ("independent", "continuous", None),
    Kind.INPUT: ("input", "continuous", None),
    Kind.STATE: ("output", "continuous", "calculated"),
    Kind.DERIVATIVE: ("local", "continuous", "calculated"),
    Kind.OUTPUT: ("output", "continuous", "calculated"),
    Kind.FIXED: ("parameter", "fixed", "exact"),
    Kind.TUNABLE: ("parameter", "tunable", "exact"),
}
_INT32 = ("-2147483648", "2147483647")
_COMMON_CAPABILITIES = {"canBeInstantiatedOnlyOncePerProcess": "false"}


def model_description(version: FmiVersion, token: str, model: Model) -> str:
    """The text of modelDescription.xml for FMI `version` with GUID or instantiation `token`."""
    root = _root(version, token, model)
    _interfaces(root, version, model)
    _units(root, model.units)
    if any(variable.type is Type.LAW for variable in model.variables):
        _types(root, version)
    _categories(root)
    experiment = {"startTime": "0", "stopTime": _number(model.stop_time), "tolerance": "1e-8"}
    if model.sampled:
        del experiment["tolerance"]
    experiment["stepSize"] = _number(model.step_size)
    ElementTree.SubElement(root, "DefaultExperiment", experiment)
    variables = ElementTree.SubElement(root, "ModelVariables")
    for variable in model.exported(version):
        _variable(variables, version, variable, model)
    _structure(root, version, model)
    return to_text(root)


def build_description(version: FmiVersion, model: Model) -> str:
    """The text of sources/buildDescription.xml: one C99 source file, linked with libm."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ElementTree.SubElement(
        root,
        "BuildConfiguration",
        modelIdentifier=model.identifier,
        description="Shared library; -ffp-contract=off keeps the results bit-identical",
    )
    sources = ElementTree.SubElement(
        build,
        "SourceFileSet",
        language="C99",
        compiler="gcc",
        compilerOptions="-O2 -ffp-contract=off",
    )
    ElementTree.SubElement(sources, "SourceFile", name=f"fmi{version}.c")
    ElementTree.SubElement(build, "Library", name="m")
    return to_text(root)


def to_text(root: ElementTree.Element) -> str:
    """The XML document of `root`, indented."""
    ElementTree.indent(root, "  ")
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'


def _root(version: FmiVersion, token: str, model: Model) -> ElementTree.Element:
    key = "guid" if version == 2 else "instantiationToken"
    attributes = {
        "fmiVersion": f"{version}.0",
        "modelName": model.name,
        key: token,
        "description": model.description,
        "version": model.version,
        "license": LICENSE,
        # The shipped files stay the same from one version to the next.
        "generationTool": f"rti-cosim {version_of('rti-cosim')}" if model.sampled else "rti-cosim",
        "variableNamingConvention": "structured",
    }
    if version == 2:
        attributes["numberOfEventIndicators"] = "0"
    return ElementTree.Element("fmiModelDescription", attributes)


def _interfaces(root: ElementTree.Element, version: FmiVersion, model: Model) -> None:
    derivatives = "true" if model.derivatives else "false"
    exchange = {"modelIdentifier": model.identifier, **_COMMON_CAPABILITIES}
    if version == 2:
        exchange |= {
            "canNotUseMemoryManagementFunctions": "true",
            "canGetAndSetFMUstate": "true",
            "canSerializeFMUstate": "true",
            "providesDirectionalDerivative": derivatives,
        }
    else:
        exchange |= {
            "canGetAndSetFMUState": "true",
            "canSerializeFMUState": "true",
            "providesDirectionalDerivatives": derivatives,
            "providesAdjointDerivatives": derivatives,
        }
    any_step = "false" if model.sampled else "true"
    simulation = {**exchange, "canHandleVariableCommunicationStepSize": any_step}
    for tag, attributes in (("ModelExchange", exchange), ("CoSimulation", simulation)):
        if tag == "ModelExchange" and not model.model_exchange:
            continue
        element = ElementTree.SubElement(root, tag, attributes)
        if version == 2:
            sources = ElementTree.SubElement(element, "SourceFiles")
            ElementTree.SubElement(sources, "File", name="fmi2.c")


def _categories(root: ElementTree.Element) -> None:
    """Append the categories of log messages that the C sources know."""
    categories = ElementTree.SubElement(root, "LogCategories")
    for name, text in _LOG_CATEGORIES.items():
        ElementTree.SubElement(categories, "Category", name=name, description=text)


def _units(root: ElementTree.Element, defined: Iterable[Unit]) -> None:
    """Append UnitDefinitions, the same in FMI 2.0 and 3.0."""
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for unit in defined:
        element = ElementTree.SubElement(units, "Unit", name=unit.name)
        base = {name: str(exponent) for name, exponent in unit.exponents}
        if unit.factor != 1.0:
            base["factor"] = repr(unit.factor)
        if unit.offset != 0.0:
            base["offset"] = repr(unit.offset)
        ElementTree.SubElement(element, "BaseUnit", base)


def _types(root: ElementTree.Element, version: FmiVersion) -> None:
    types = ElementTree.SubElement(root, "TypeDefinitions")
    if version == 2:
        simple = ElementTree.SubElement(types, "SimpleType", name="Law")
        enumeration = ElementTree.SubElement(simple, "Enumeration")
    else:
        enumeration = ElementTree.SubElement(types, "EnumerationType", name="Law")
    for name, value, text in LAWS:
        ElementTree.SubElement(enumeration, "Item", name=name, value=str(value), description=text)


def _number(value: float) -> str:
    """The shortest text that reads back to `value`, without a fraction where there is none."""
    return repr(float(value)).removesuffix(".0")


def _common_attributes(variable: Variable, model: Model) -> dict[str, str]:
    """The attributes that every variable has in FMI 2.0 and 3.0."""
    causality, variability, initial = _CAUSALITY[variable.kind]
    if variable.kind is Kind.OUTPUT and model.sampled:
        variability = "discrete"
    attributes = {
        "name": variable.name,
        "valueReference": str(model.value_reference(variable.name)),
        "description": variable.description,
        "causality": causality,
        "variability": variability,
    }
    if initial is not None:
        attributes["initial"] = initial
    return attributes


def _real_attributes(variable: Variable) -> dict[str, str]:
    """Unit, range, nominal and start value of a real variable."""
    attributes = {"unit": variable.unit} if variable.unit else {}
    for key in ("min", "max", "nominal", "start"):
        value = getattr(variable, key)
        if value is not None and not (key == "nominal" and value == 0.0):
            attributes[key] = repr(float(value))
    return attributes


def _state_of(variable: Variable) -> str:
    return variable.name.removeprefix("der(").removesuffix(")")


def _variable(
    parent: ElementTree.Element, version: FmiVersion, variable: Variable, model: Model
) -> None:
    tag, attributes = _value(version, variable, model)
    common = _common_attributes(variable, model)
    if version == 2:
        parent = ElementTree.SubElement(parent, "ScalarVariable", common)
    else:
        attributes = common | attributes
    ElementTree.SubElement(parent, tag, attributes)


def _value(version: FmiVersion, variable: Variable, model: Model) -> tuple[str, dict[str, str]]:
    """The element of a variable's type and its attributes."""
    if variable.type is Type.BOOLEAN:
        return "Boolean", {"start": "true" if variable.start else "false"}
    if variable.type is Type.LAW:
        return "Enumeration", {"declaredType": "Law", "min": "1", "max": "2", "start": "1"}
    if variable.type is Type.LAW_NUMBER:
        return "Integer", {"min": "0", "max": "2", "start": "0"}
    if variable.type in (Type.SEED, Type.SEED_HIGH):
        if version == 3:
            return "UInt64", {"min": "0", "max": str(2**64 - 1), "start": "0"}
        return "Integer", {"min": _INT32[0], "max": _INT32[1], "start": "0"}
    attributes = _real_attributes(variable)
    if variable.kind is Kind.DERIVATIVE:
        state = _state_of(variable)
        attributes["derivative"] = str(
            index(state, model) if version == 2 else model.value_reference(state)
        )
    return "Real" if version == 2 else "Float64", attributes


def index(name: str, model: Model) -> int:
    """Position of a variable in the model description of FMI 2.0, from 1."""
    return [v.name for v in model.exported(2)].index(name) + 1


_UNKNOWNS = (
    ("Output", (Kind.STATE, Kind.OUTPUT), continuous_dependencies),
    ("ContinuousStateDerivative", (Kind.DERIVATIVE,), continuous_dependencies),
    ("InitialUnknown", (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT), initial_dependencies),
)
_GROUPS = {
    "Output": "Outputs",
    "ContinuousStateDerivative": "Derivatives",
    "InitialUnknown": "InitialUnknowns",
}
"""FMI 2.0's elements around the unknowns."""


def _structure(root: ElementTree.Element, version: FmiVersion, model: Model) -> None:
    """Append ModelStructure: the unknowns and what they depend on."""
    structure = ElementTree.SubElement(root, "ModelStructure")
    shown = {v.name for v in model.exported(version)}
    for tag, kinds, dependencies in _UNKNOWNS:
        if not (unknowns := model.names(*kinds)):
            continue
        parent = structure
        if version == 2:
            parent = ElementTree.SubElement(structure, _GROUPS[tag])
        for name in unknowns:
            names = [n for n in dependencies(name, model) if n in shown]
            # The states depend on themselves or on their start with constant factor 1.
            kind = "constant" if model.by_name[name].kind is Kind.STATE else "dependent"
            number = index if version == 2 else _reference
            ElementTree.SubElement(
                parent,
                "Unknown" if version == 2 else tag,
                {
                    "index" if version == 2 else "valueReference": str(number(name, model)),
                    "dependencies": " ".join(str(number(n, model)) for n in names),
                    "dependenciesKind": " ".join([kind] * len(names)),
                },
            )


def _reference(name: str, model: Model) -> int:
    return model.value_reference(name)


_SEED_MAX = 4294967295.0


def c_header(token: str, identifier: str, variables: Sequence[Variable], origin: str) -> str:
    """The header's text: value references, types, starts and ranges, and the model's `token`.

    With it FMI's functions are called ``identifier_fmi2…`` and so on, so that several models link
    into one program; whoever builds a library defines FMI2_ or FMI3_OVERRIDE_FUNCTION_PREFIX.
    """
    references = "\n".join(f"    VR_{v.identifier} = {i}," for i, v in enumerate(variables))
    rows = "\n".join(f"    {_row(variable)}," for variable in variables)
    return f"""\
/* Generated {origin}; do not edit. */
#ifndef VARIABLES_H
#define VARIABLES_H

#ifndef FMI2_FUNCTION_PREFIX
#define FMI2_FUNCTION_PREFIX {identifier}_
#endif
#ifndef FMI3_FUNCTION_PREFIX
#define FMI3_FUNCTION_PREFIX {identifier}_
#endif

#define MODEL_TOKEN "{token}"

/* Digest of the variables' names and order: marks the layout of a serialised state. */
#define LAYOUT_DIGEST UINT64_C(0x{_layout_digest(variables)})

enum {{
{references}
    N_VARIABLES = {len(variables)}
}};

typedef enum {{ {", ".join(Type.__members__)} }} VariableType;

typedef enum {{ {", ".join(Kind.__members__)} }} VariableKind;

typedef struct {{
    const char *name;
    VariableType type;
    VariableKind kind;
    double start, min, max, nominal;
}} VariableInfo;

static const VariableInfo VARIABLES[N_VARIABLES] = {{
{rows}
}};

#endif
"""


def _layout_digest(variables: Sequence[Variable]) -> str:
    names = "\n".join(variable.name for variable in variables)
    return hashlib.sha256(names.encode()).hexdigest()[:16]


def _row(variable: Variable) -> str:
    seed = variable.type in (Type.SEED, Type.SEED_HIGH)
    numbers = (
        variable.start,
        0.0 if seed else variable.min,
        _SEED_MAX if seed else variable.max,
        1.0 if variable.nominal is None else variable.nominal,
    )
    values = ", ".join(repr(float(number or 0.0)) for number in numbers)
    return f'{{"{variable.name}", {variable.type.name}, {variable.kind.name}, {values}}}'
