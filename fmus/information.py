"""What an FMU says of itself, by fmpy's model description, the standard's schema and the file."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fmpy
from fmpy import read_model_description
from fmpy.model_description import ModelDescription
from lxml import etree

from fmus import FmuError
from fmus.build import platforms_of

_INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}
_LIBRARIES = (".so", ".dll", ".dylib")
VARIABLE = (
    "name", "valueReference", "type", "causality", "variability", "unit", "start", "min", "max",
    "description",
)  # fmt: skip


@dataclass(frozen=True)
class Information:
    """An FMU file: its path, SHA-256 and fmpy's `description` of the model.

    `flags` are the capability flags of each interface, by its name in words, with the standard's
    default where the file says nothing; `platforms` are the folders under ``binaries/`` with what
    their libraries are made for by their own first bytes, and ``c-code`` for sources.
    """

    path: str
    sha256: str
    description: ModelDescription
    flags: dict[str, dict[str, str]]
    platforms: dict[str, tuple[str, ...]]

    def to_dict(self) -> dict[str, Any]:
        """All of it as plain data; of each variable the attributes in `VARIABLE`."""
        about, experiment = self.description, self.description.defaultExperiment
        times = [getattr(experiment, n, None) for n in ("startTime", "stopTime", "stepSize")]
        start, stop, step = (None if t is None else float(t) for t in times)
        return {
            "path": self.path,
            "sha256": self.sha256,
            "fmi_version": about.fmiVersion,
            "name": about.modelName,
            "description": about.description or "",
            "interfaces": list(self.flags),
            "platforms": self.platforms,
            "flags": self.flags,
            "start_time": start,
            "stop_time": stop,
            "step_size": step,
            "variables": [{n: getattr(v, n) for n in VARIABLE} for v in about.modelVariables],
        }


def description_of(fmu: Path) -> ModelDescription:
    """The model description in the file `fmu`; FmuError when it is missing or is no FMU."""
    if not fmu.is_file():
        raise FmuError(f"there is no file {fmu}")
    try:
        return read_model_description(str(fmu), validate=False)
    except Exception as error:
        raise FmuError(f"{fmu} is not an FMU: {error}") from error


def information(fmu: Path, description: ModelDescription | None = None) -> Information:
    """Read the FMU file `fmu`; raises FmuError when it is missing or is no FMU.

    `description` is that of the file where it has been read already: a large one takes seconds.
    """
    description = description or description_of(fmu)
    with zipfile.ZipFile(fmu) as container:
        names = {entry.filename.replace("\\", "/"): entry for entry in container.infolist()}
        text = container.read(names["modelDescription.xml"])
        platforms = {
            name.split("/")[1]: platforms_of(container.read(entry)) or ("not a library",)
            for name, entry in sorted(names.items())
            if name.startswith("binaries/") and name.count("/") == 2 and name.endswith(_LIBRARIES)
        }
    if any(name.startswith("sources/") and name.endswith(".c") for name in names):
        platforms["c-code"] = ()
    return Information(
        path=str(fmu),
        sha256=hashlib.sha256(fmu.read_bytes()).hexdigest(),
        description=description,
        flags=_flags(text, str(description.fmiVersion)),
        platforms=platforms,
    )


def _flags(text: bytes, version: str) -> dict[str, dict[str, str]]:
    root = etree.fromstring(text)
    if version == "1.0":  # has no flags; only co-simulation has an element of its own
        tool = root.find("Implementation") is not None
        return {"co-simulation" if tool else "model exchange": {}}
    folder = f"fmi{version[0]}"
    file = Path(fmpy.__file__).parent / "schema" / folder / f"{folder}ModelDescription.xsd"
    if file.is_file():
        # Validation writes the schema's defaults into the elements, which is all it is for here.
        for element in root:
            if element.tag not in _INTERFACES:
                del element[:]
        etree.XMLSchema(file=str(file), attribute_defaults=True).validate(root)
    found = {name: root.find(tag) for tag, name in _INTERFACES.items()}
    return {
        name: {key: value for key, value in element.attrib.items() if key != "modelIdentifier"}
        for name, element in found.items()
        if element is not None
    }
