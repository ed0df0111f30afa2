"""The continuous states that an FMU's model description declares."""

from __future__ import annotations

import zipfile
from functools import cache
from pathlib import Path
from xml.etree import ElementTree


@cache
def continuous_states(fmu: Path) -> tuple[str, ...]:
    """Names of the variables whose time derivative is in the model description, of FMI 2.0 or 3.0.

    Args:
        fmu: path of the FMU.

    Returns:
        The names in the order of the derivatives; none where the file cannot be read, or declares
        no derivatives.
    """
    try:
        with zipfile.ZipFile(fmu) as archive:
            root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    except (OSError, KeyError, zipfile.BadZipFile, ElementTree.ParseError):
        return ()
    variables = root.find("ModelVariables")
    if variables is None:
        return ()
    fmi2 = root.get("fmiVersion", "").startswith("2")
    names = {}
    derivatives = []
    for position, variable in enumerate(variables, start=1):
        # FMI 2.0 has the type as a child and counts from 1, FMI 3.0 points by the value reference.
        reference = str(position) if fmi2 else variable.get("valueReference", "")
        names[reference] = variable.get("name", "")
        attributes = variable.find("Real") if fmi2 else variable
        if attributes is not None and attributes.get("derivative"):
            derivatives.append(attributes.get("derivative", ""))
    return tuple(names[reference] for reference in derivatives if reference in names)
