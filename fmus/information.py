"""What an FMU says of itself: interfaces, capabilities, variables, default experiment, hash."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from fmpy import read_model_description
from fmpy.model_description import InterfaceType, ModelDescription, ScalarVariable

from fmus.errors import FmuError

_CAPABILITIES = {
    "canGetAndSetFMUstate": "get and set the state",
    "canSerializeFMUstate": "serialise the state",
    "providesDirectionalDerivative": "directional derivatives",
    "providesAdjointDerivatives": "adjoint derivatives",
    "canHandleVariableCommunicationStepSize": "variable communication step",
    "canBeInstantiatedOnlyOncePerProcess": "one instance per process only",
}


@dataclass(frozen=True)
class VariableSummary:
    """One variable as its model description has it; a number that is not given is None."""

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
    """Contents of a model description, and the file's SHA-256."""

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


def information(fmu: Path) -> Information:
    """Read the FMU file `fmu`; raises FmuError when it is missing or is no FMU."""
    if not fmu.is_file():
        raise FmuError(f"there is no file {fmu}")
    try:
        description = read_model_description(str(fmu), validate=False)
    except Exception as error:
        raise FmuError(f"{fmu} is not an FMU: {error}") from error
    interfaces = _interfaces(description)
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
        capabilities=_capabilities(list(interfaces.values())),
        start_time=start,
        stop_time=stop,
        step_size=step,
        variables=tuple(_summary(v) for v in description.modelVariables),
    )


def _interfaces(description: ModelDescription) -> dict[str, InterfaceType]:
    found = {
        "co-simulation": description.coSimulation,
        "model exchange": description.modelExchange,
        "scheduled execution": description.scheduledExecution,
    }
    return {name: interface for name, interface in found.items() if interface is not None}


def _capabilities(interfaces: list[InterfaceType]) -> tuple[str, ...]:
    return tuple(
        text
        for attribute, text in _CAPABILITIES.items()
        if any(getattr(interface, attribute, False) for interface in interfaces)
    )


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
