"""An FMU's generated texts, from `templates/`: model description, build description, C header."""

from __future__ import annotations

import hashlib
import html
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from fmus.model import (
    FmiVersion,
    Kind,
    Model,
    Type,
    Variable,
    continuous_dependencies,
    initial_dependencies,
)

LICENSE = "MIT"
TEMPLATES = Path(__file__).parent / "templates"

Attributes = Mapping[str, object]


def render(template: str, **values: object) -> str:
    """The text that a template of `TEMPLATES` makes of `values`.

    Filters: `xml` and `html` escape a text; `attributes` writes a mapping as XML attributes, but
    for those that are None; `number` writes a number.
    """
    text: str = _template(template).render(values)
    return text


@cache
def _template(name: str) -> Any:
    import jinja2  # noqa: PLC0415 (whoever steps an FMU builds none)

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "attributes": _attributes, "html": html.escape, "number": _number, "xml": _xml,
    }  # fmt: skip
    return environment.get_template(name)


def _xml(text: str) -> str:
    return html.escape(text, quote=False).replace('"', "&quot;").replace("\n", "&#10;")


def _attributes(values: Attributes) -> str:
    pairs = ((key, value) for key, value in values.items() if value is not None)
    return "".join(f' {key}="{_xml(str(value))}"' for key, value in pairs)


def _number(value: float) -> str:
    """The shortest text that reads back to `value`, without a fraction where there is none."""
    return repr(float(value)).removesuffix(".0")


_CAUSALITY = {
    Kind.INDEPENDENT: ("independent", "continuous", None),
    Kind.INPUT: ("input", "continuous", None),
    Kind.STATE: ("output", "continuous", "calculated"),
    Kind.DERIVATIVE: ("local", "continuous", "calculated"),
    Kind.OUTPUT: ("output", "continuous", "calculated"),
    Kind.FIXED: ("parameter", "fixed", "exact"),
    Kind.TUNABLE: ("parameter", "tunable", "exact"),
}


def model_description(version: FmiVersion, token: str, model: Model) -> str:
    """The text of modelDescription.xml for FMI `version` with GUID or instantiation `token`."""
    return render(
        "modelDescription.xml",
        version=version,
        token=token,
        model=model,
        license=LICENSE,
        # The shipped files stay the same from one version to the next.
        tool=f"rti-cosim {version_of('rti-cosim')}" if model.sampled else "rti-cosim",
        types={variable.type.name for variable in model.variables},
        variables=[
            (_common_attributes(variable, model), *_type(version, variable, model))
            for variable in model.exported(version)
        ],
        structure=_structure(version, model),
    )


def build_description(version: FmiVersion, model: Model) -> str:
    """The text of sources/buildDescription.xml: one C99 source file, linked with libm."""
    return render("buildDescription.xml", version=version, model=model)


def _common_attributes(variable: Variable, model: Model) -> Attributes:
    """The attributes that every variable has in FMI 2.0 and 3.0."""
    causality, variability, initial = _CAUSALITY[variable.kind]
    if variable.kind is Kind.OUTPUT and model.sampled:
        variability = "discrete"
    if variable.kind is Kind.INPUT and variable.type is not Type.REAL:
        variability = "discrete"
    return {
        "name": variable.name,
        "valueReference": model.value_reference(variable.name),
        "description": variable.description,
        "causality": causality,
        "variability": variability,
        "initial": initial,
    }


def _type(version: FmiVersion, variable: Variable, model: Model) -> tuple[str, Attributes]:
    """The element of a variable's type and its attributes."""
    if variable.type is Type.BOOLEAN:
        return "Boolean", {"start": "true" if variable.start else "false"}
    if variable.type is Type.LAW:
        return "Enumeration", {"declaredType": "Law", "min": 1, "max": 2, "start": 1}
    if variable.type is Type.LAW_NUMBER:
        return "Integer", {"min": 0, "max": 2, "start": 0}
    if variable.type in (Type.SEED, Type.SEED_HIGH):
        if version == 3:
            return "UInt64", {"min": 0, "max": 2**64 - 1, "start": 0}
        return "Integer", {"min": -(2**31), "max": 2**31 - 1, "start": 0}
    attributes: dict[str, object] = {"unit": variable.unit or None}
    for key in ("min", "max", "nominal", "start"):
        value = getattr(variable, key)
        if value is not None and not (key == "nominal" and value == 0.0):
            attributes[key] = float(value)
    if variable.kind is Kind.DERIVATIVE:
        state = variable.name.removeprefix("der(").removesuffix(")")
        attributes["derivative"] = _numbering(version, model)(state)
    return "Real" if version == 2 else "Float64", attributes


def _numbering(version: FmiVersion, model: Model) -> Callable[[str], int]:
    """How the description points to a variable: FMI 2.0 by its position, from 1."""
    if version == 3:
        return model.value_reference
    names = [variable.name for variable in model.exported(2)]
    return lambda name: names.index(name) + 1


_UNKNOWNS = (
    ("Output", "Outputs", (Kind.STATE, Kind.OUTPUT), continuous_dependencies),
    ("ContinuousStateDerivative", "Derivatives", (Kind.DERIVATIVE,), continuous_dependencies),
    ("InitialUnknown", "InitialUnknowns", (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT),
     initial_dependencies),
)  # fmt: skip
"""FMI 3.0's element of an unknown, FMI 2.0's around them, which they are, what they depend on."""


def _structure(version: FmiVersion, model: Model) -> list[tuple[str, str, list[Attributes]]]:
    """The unknowns of ModelStructure, group by group, and what they depend on."""
    number = _numbering(version, model)
    shown = {variable.name for variable in model.exported(version)}

    def unknown(name: str, dependencies: Sequence[str]) -> Attributes:
        numbers = [str(number(n)) for n in dependencies if n in shown]
        # The states depend on themselves or on their start with constant factor 1.
        kind = "constant" if model.by_name[name].kind is Kind.STATE else "dependent"
        return {
            "index" if version == 2 else "valueReference": number(name),
            "dependencies": " ".join(numbers),
            "dependenciesKind": " ".join([kind] * len(numbers)),
        }

    return [
        (tag, group, [unknown(name, dependencies(name, model)) for name in names])
        for tag, group, kinds, dependencies in _UNKNOWNS
        if (names := model.names(*kinds))
    ]


_SEED_MAX = 4294967295.0


def c_header(token: str, identifier: str, variables: Sequence[Variable], origin: str) -> str:
    """The header's text: value references, types, starts and ranges, and the model's `token`.

    With it FMI's functions are called ``identifier_fmi2…`` and so on, so that several models link
    into one program; whoever builds a library defines FMI2_ or FMI3_OVERRIDE_FUNCTION_PREFIX.
    """
    names = "\n".join(variable.name for variable in variables)
    return render(
        "variables.h",
        token=token,
        identifier=identifier,
        variables=variables,
        origin=origin,
        layout=hashlib.sha256(names.encode()).hexdigest()[:16],
        types=list(Type.__members__),
        kinds=list(Kind.__members__),
        numbers=_numbers,
    )


def _numbers(variable: Variable) -> tuple[float, ...]:
    """Start, range and nominal value as the C has them."""
    seed = variable.type in (Type.SEED, Type.SEED_HIGH)
    low, high = (0.0, _SEED_MAX) if seed else (variable.min, variable.max)
    nominal = 1.0 if variable.nominal is None else variable.nominal
    return tuple(float(number or 0.0) for number in (variable.start, low, high, nominal))
