"""What an FMU says of itself: interfaces, capabilities, variables, default experiment, hash."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from fmpy import read_model_description
from fmpy.model_description import ModelDescription, ScalarVariable

from fmus import FmuError
from fmus.build import platforms_of
from fmus.flags import default_flags

_INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}
# Attributes of an interface that are no flag.
_NAMES = ("modelIdentifier",)
_LIBRARIES = (".so", ".dll", ".dylib")


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

    `fmi_version`, name and description of the model; `interfaces` in words; `platforms`, folders
    under ``binaries/`` with what their libraries are made for by their own first bytes, as FMI
    3.0's tuples, and ``c-code`` for sources; `flags`, for each interface all capability flags that
    the standard has, with the default where the file says nothing; the default experiment's
    `start_time`, `stop_time` and `step_size` in s; all `variables`.
    """

    path: str
    sha256: str
    fmi_version: str
    name: str
    description: str
    interfaces: tuple[str, ...]
    platforms: dict[str, tuple[str, ...]]
    flags: dict[str, dict[str, str]]
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
    members = _members(fmu)
    interfaces = _interfaces(members)
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
        platforms=_platforms(members),
        flags={
            name: _flags(description.fmiVersion, name, given) for name, given in interfaces.items()
        },
        start_time=start,
        stop_time=stop,
        step_size=step,
        variables=tuple(_summary(v) for v in description.modelVariables),
    )


def _members(fmu: Path) -> dict[str, bytes]:
    """Model description, libraries and names of sources, by path with slashes."""
    found = {}
    with zipfile.ZipFile(fmu) as container:
        for entry in container.infolist():
            name = entry.filename.replace("\\", "/")
            wanted = name == "modelDescription.xml" or name.endswith(_LIBRARIES)
            if wanted or name.startswith("sources/"):
                found[name] = container.read(entry) if wanted else b""
    return found


def _interfaces(members: dict[str, bytes]) -> dict[str, dict[str, str]]:
    """Interface → its attributes, from the XML: fmpy misses FMI 3.0's directional derivatives."""
    root = ElementTree.fromstring(members["modelDescription.xml"])
    found = {name: root.find(tag) for tag, name in _INTERFACES.items()}
    if root.get("fmiVersion") == "1.0":
        tool = root.find("Implementation")  # only co-simulation FMUs have one
        found = {"model exchange": root} if tool is None else {"co-simulation": tool}
        return {name: {} for name in found}
    return {name: dict(element.attrib) for name, element in found.items() if element is not None}


def _platforms(members: dict[str, bytes]) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for name, data in sorted(members.items()):
        parts = name.split("/")
        if parts[0] == "binaries" and len(parts) == 3 and data:
            found[parts[1]] = platforms_of(data) or ("not a library",)
    if any(name.startswith("sources/") and name.endswith(".c") for name in members):
        found["c-code"] = ()
    return found


def _flags(version: str, interface: str, given: dict[str, str]) -> dict[str, str]:
    """The standard's flags with their values, then what else the file gives."""
    flags = dict(default_flags(version, interface))
    return flags | {key: value for key, value in given.items() if key not in _NAMES}


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
