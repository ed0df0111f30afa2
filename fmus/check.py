"""The description of an FMU: what it states, and fmpy's validation of it."""

from __future__ import annotations

import hashlib
import re
import zipfile
from pathlib import Path
from typing import Any

import fmpy
from fmpy.model_description import ModelDescription
from fmpy.validation import validate_fmu
from lxml import etree

from fmus import CheckError, FmuError, platforms_of

_INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}
_VARIABLE = (
    "name", "valueReference", "type", "causality", "variability", "unit", "start", "min", "max",
    "description",
)  # fmt: skip


def description_of(fmu: Path) -> ModelDescription:
    """The model description in the file `fmu`; FmuError when it is missing or is no FMU."""
    if not fmu.is_file():
        raise FmuError(f"there is no file {fmu}")
    try:
        return fmpy.read_model_description(str(fmu), validate=False)
    except Exception as error:
        raise FmuError(f"{fmu} is not an FMU: {error}") from error


def information(fmu: Path, description: ModelDescription | None = None) -> dict[str, Any]:
    """The description of the file `fmu`; raises FmuError when it is missing or is no FMU.

    ``flags`` are the capability flags that each interface states, by its name in words;
    ``platforms`` are the folders under ``binaries/`` with what their libraries are made for by
    their own first bytes, and ``c-code`` for sources. `description` is that of the file where it
    has been read already: a large one takes seconds.
    """
    about = description or description_of(fmu)
    with zipfile.ZipFile(fmu) as container:
        names = {entry.filename.replace("\\", "/"): entry for entry in container.infolist()}
        root = etree.fromstring(container.read(names["modelDescription.xml"]))
        platforms = {
            name.split("/")[1]: platforms_of(container.read(entry)) or ("not a library",)
            for name, entry in sorted(names.items())
            if re.fullmatch(r"binaries/[^/]+/[^/]+\.(so|dll|dylib)", name)
        }
    if any(name.startswith("sources/") and name.endswith(".c") for name in names):
        platforms["c-code"] = ()
    flags = {
        words: {key: value for key, value in face.attrib.items() if key != "modelIdentifier"}
        for tag, words in _INTERFACES.items()
        if (face := root.find(tag)) is not None
    }
    times = {"start_time": "startTime", "stop_time": "stopTime", "step_size": "stepSize"}
    stated = {key: getattr(about.defaultExperiment, name, None) for key, name in times.items()}
    return {
        "path": str(fmu),
        "sha256": hashlib.sha256(fmu.read_bytes()).hexdigest(),
        "fmi_version": about.fmiVersion,
        "name": about.modelName,
        "description": about.description or "",
        "interfaces": list(flags),
        "platforms": platforms,
        "flags": flags,
        **{key: _number(value) for key, value in stated.items()},
        "variables": [{n: getattr(v, n) for n in _VARIABLE} for v in about.modelVariables],
    }


def _number(stated: str | None) -> float | None:
    """A number of the description; None where it states none, or a text that is no number."""
    try:
        return None if stated is None else float(stated)
    except ValueError:
        return None


class NotOfferedError(FmuError):
    """The FMU or the importer lacks the interface that the check needs."""


def validate(fmu: Path) -> str:
    """Schema, names, model structure, start values and units; raises CheckError on a problem."""
    if problems := problems_of(fmu):
        raise CheckError("; ".join(problems))
    return "no problem found"


def problems_of(fmu: Path) -> list[str]:
    """What an FMU, a file or an unpacked folder, has against FMI's rules of its description."""
    return [" ".join(str(problem).split()) for problem in validate_fmu(str(fmu))]


def declared_variables(fmu: Path) -> str:
    """Every number that the description declares can be read, before and after a step."""
    description = description_of(fmu)
    if description.coSimulation is None and description.modelExchange is None:
        raise NotOfferedError("the FMU has neither co-simulation nor model exchange")
    names = [variable.name for variable in description.modelVariables]
    stated = getattr(description.defaultExperiment, "stepSize", None)
    step = _number(stated) or 1.0
    fmpy.simulate_fmu(str(fmu), output=names, start_time=0.0, stop_time=step, output_interval=step)
    return f"{len(names)} read"
