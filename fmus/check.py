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
    "name",
    "valueReference",
    "type",
    "causality",
    "variability",
    "unit",
    "start",
    "min",
    "max",
    "description",
)
"""Attributes of a variable in the report."""


def description_of(fmu: Path) -> ModelDescription:
    """The model description in the file `fmu`; FmuError when it is missing or is no FMU."""
    if not fmu.is_file():
        raise FmuError(f"there is no file {fmu}")
    try:
        return fmpy.read_model_description(str(fmu), validate=False)
    except Exception as error:
        raise FmuError(f"{fmu} is not an FMU: {error}") from error


def information(fmu: Path, description: ModelDescription | None = None) -> dict[str, Any]:
    """The description of an FMU as words and numbers.

    ``flags`` are the capability flags that each interface states, by its name in words;
    ``platforms`` are the folders under ``binaries/`` with what their libraries are made for by
    their own first bytes, and ``c-code`` for sources.

    Args:
        fmu: the file.
        description: of the file, where it has been read already: a large one takes seconds.

    Raises:
        FmuError: the file is missing or is no FMU.
    """
    model = description or description_of(fmu)
    platforms: dict[str, tuple[str, ...]] = {}
    with zipfile.ZipFile(fmu) as container:
        entries = {}
        for entry in container.infolist():
            # Some tools on Windows write backslashes.
            name = entry.filename.replace("\\", "/")
            entries[name] = entry
        text = container.read(entries["modelDescription.xml"])
        root = etree.fromstring(text)
        for name, entry in sorted(entries.items()):
            library = re.fullmatch(r"binaries/([^/]+)/[^/]+\.(so|dll|dylib)", name)
            if library is not None:
                # What it is made for its own bytes say: a folder may have any name.
                made_for = platforms_of(container.read(entry))
                platforms[library[1]] = made_for or ("not a library",)
    for name in entries:
        if name.startswith("sources/") and name.endswith(".c"):
            platforms["c-code"] = ()
    flags = {}
    for tag, words in _INTERFACES.items():
        element = root.find(tag)
        if element is not None:
            attributes = dict(element.attrib)
            # It is a name, and no ability.
            attributes.pop("modelIdentifier", None)
            flags[words] = attributes
    experiment = model.defaultExperiment
    variables = []
    for variable in model.modelVariables:
        facts = {name: getattr(variable, name) for name in _VARIABLE}
        variables.append(facts)
    return {
        "path": str(fmu),
        "sha256": hashlib.sha256(fmu.read_bytes()).hexdigest(),
        "fmi_version": model.fmiVersion,
        "name": model.modelName,
        "description": model.description or "",
        "interfaces": list(flags),
        "platforms": platforms,
        "flags": flags,
        "start_time": _optional_number(getattr(experiment, "startTime", None)),
        "stop_time": _optional_number(getattr(experiment, "stopTime", None)),
        "step_size": _optional_number(getattr(experiment, "stepSize", None)),
        "variables": variables,
    }


def _optional_number(stated: str | None) -> float | None:
    """A number of the description; None where it states none, or a text that is no number."""
    try:
        return None if stated is None else float(stated)
    except ValueError:
        return None


class NotOfferedError(FmuError):
    """The FMU or the importer lacks the interface that the check needs."""


def validate(fmu: Path) -> str:
    """Schema, names, model structure, start values and units; raises CheckError on a problem."""
    problems = problems_of(fmu)
    if problems:
        raise CheckError("; ".join(problems))
    return "no problem found"


def problems_of(fmu: Path) -> list[str]:
    """Violations of FMI's rules in the description of an FMU, a file or an unpacked folder."""
    lines = []
    for problem in validate_fmu(str(fmu)):
        # One line each: those of lxml have several.
        words = str(problem).split()
        lines.append(" ".join(words))
    return lines


def declared_variables(fmu: Path) -> str:
    """Every number that the description declares can be read, before and after a step."""
    description = description_of(fmu)
    if description.coSimulation is None and description.modelExchange is None:
        raise NotOfferedError("the FMU has neither co-simulation nor model exchange")
    names = [variable.name for variable in description.modelVariables]
    stated = getattr(description.defaultExperiment, "stepSize", None)
    step = _optional_number(stated) or 1.0
    # One step: fmpy records every output before it and after.
    fmpy.simulate_fmu(
        str(fmu),
        output=names,
        start_time=0.0,
        stop_time=step,
        output_interval=step,
    )
    return f"{len(names)} read"
