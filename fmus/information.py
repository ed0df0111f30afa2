"""What an FMU says of itself: interfaces, capabilities, variables, default experiment, hash."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from fmpy import read_model_description
from fmpy.model_description import ModelDescription, ScalarVariable

from fmus.errors import FmuError

_INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}
# Spelt differently by FMI 2.0 and 3.0: compared in lower case, without a plural's s.
_CAPABILITIES = {
    "cangetandsetfmustate": "get and set the state",
    "canserializefmustate": "serialise the state",
    "providesdirectionalderivative": "directional derivatives",
    "providesadjointderivative": "adjoint derivatives",
    "canhandlevariablecommunicationstepsize": "variable communication step",
    "canbeinstantiatedonlyonceperproces": "one instance per process only",
}


@dataclass(frozen=True)
class VariableSummary:
    """One variable as its model description has it.

    Its name, value `reference`, FMI `type`, causality, variability, unit, description, and the
    texts of `start`, `min` and `max`; what is not given is None.
    """

    name: str
    reference: int
    type: str
    causality: str
    variability: str
    unit: str | None
    start: str | None
    min: str | None
    max: str | None
    description: str


@dataclass(frozen=True)
class Information:
    """Contents of a model description, and the file's path and SHA-256 (`sha256`).

    `fmi_version`, name and description of the model; `interfaces` and `capabilities` in words;
    the default experiment's `start_time`, `stop_time` and `step_size` in s; all `variables`.
    """

    path: str
    sha256: str
    fmi_version: str
    name: str
    description: str
    interfaces: tuple[str, ...]
    capabilities: tuple[str, ...]
    start_time: float | None
    stop_time: float | None
    step_size: float | None
    variables: tuple[VariableSummary, ...]


def description_of(fmu: Path) -> ModelDescription:
    """The model description in the file `fmu`; FmuError when it is missing or is no FMU."""
    if not fmu.is_file():
        raise FmuError(f"there is no file {fmu}")
    try:
        return read_model_description(str(fmu), validate=False)
    except Exception as error:
        raise FmuError(f"{fmu} is not an FMU: {error}") from error


def information(fmu: Path) -> Information:
    """Read the FMU file `fmu`; raises FmuError when it is missing or is no FMU."""
    description = description_of(fmu)
    interfaces = _interfaces(fmu)
    experiment = description.defaultExperiment
    times = [getattr(experiment, n, None) for n in ("startTime", "stopTime", "stepSize")]
    start, stop, step = (None if t is None else float(t) for t in times)
    return Information(
        path=str(fmu),
        sha256=hashlib.sha256(fmu.read_bytes()).hexdigest(),
        fmi_version=description.fmiVersion,
        name=description.modelName,
        description=description.description or "",
        interfaces=tuple(interfaces),
        capabilities=_capabilities(interfaces.values()),
        start_time=start,
        stop_time=stop,
        step_size=step,
        variables=tuple(_summary(v) for v in description.modelVariables),
    )


def _interfaces(fmu: Path) -> dict[str, dict[str, str]]:
    """Interface → its attributes, from the XML: fmpy misses FMI 3.0's directional derivatives."""
    with zipfile.ZipFile(fmu) as container:
        root = ElementTree.fromstring(container.read("modelDescription.xml"))
    found = {name: root.find(tag) for tag, name in _INTERFACES.items()}
    return {name: element.attrib for name, element in found.items() if element is not None}


def _capabilities(interfaces: Iterable[dict[str, str]]) -> tuple[str, ...]:
    given = {
        key.lower().rstrip("s")
        for attributes in interfaces
        for key, value in attributes.items()
        if value in ("true", "1")
    }
    return tuple(text for key, text in _CAPABILITIES.items() if key in given)


def _summary(variable: ScalarVariable) -> VariableSummary:
    return VariableSummary(
        name=variable.name,
        reference=variable.valueReference,
        type=variable.type,
        causality=variable.causality,
        variability=variable.variability or "",
        unit=variable.unit,
        start=None if variable.start is None else str(variable.start),
        min=variable.min,
        max=variable.max,
        description=variable.description or "",
    )
