"""Declared memory of an FMU: continuous states, time constants."""

from __future__ import annotations

import zipfile
from functools import cache
from pathlib import Path
from xml.etree import ElementTree


@cache
def _variables(fmu: Path) -> tuple[bool, tuple[ElementTree.Element, ...]]:
    """True for FMI 2.0, and the variables; none where the file cannot be read."""
    try:
        with zipfile.ZipFile(fmu) as archive:
            root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    except (OSError, KeyError, zipfile.BadZipFile, ElementTree.ParseError):
        return False, ()
    is_fmi2 = root.get("fmiVersion", "").startswith("2")
    table = root.find("ModelVariables")
    # An FMU need not have any.
    if table is None:
        return is_fmi2, ()
    return is_fmi2, tuple(table)


def _real_attribute(
    variable: ElementTree.Element,
    name: str,
    fmi2: bool,
) -> str:
    """An attribute of a real variable: FMI 2.0 has it at the type, a child; empty without one."""
    element = variable.find("Real") if fmi2 else variable
    # A variable of another type.
    if element is None:
        return ""
    return element.get(name, "")


def continuous_states(fmu: Path) -> tuple[str, ...]:
    """Names of the variables whose time derivative an FMU declares, of FMI 2.0 or 3.0.

    Args:
        fmu: path of the FMU.

    Returns:
        The names in the order of the derivatives; none where the file cannot be read, or declares
        no derivatives.
    """
    fmi2, variables = _variables(fmu)
    names = {}
    derivatives = []
    for position, variable in enumerate(variables, start=1):
        # FMI 2.0 counts from 1, FMI 3.0 points by the value reference.
        reference = str(position) if fmi2 else variable.get("valueReference", "")
        names[reference] = variable.get("name", "")
        # The rate names its state.
        derivative = _real_attribute(variable, "derivative", fmi2)
        if derivative:
            derivatives.append(derivative)
    # A reference that leads nowhere is a flaw of the file, and no state.
    states = []
    for reference in derivatives:
        if reference in names:
            states.append(names[reference])
    return tuple(states)


def time_constants(fmu: Path) -> dict[str, float]:
    """Time constant in s of each disturbance that one of our plants filters if nobody sets it.

    Args:
        fmu: path of the FMU.

    Returns:
        The start of each parameter `NAME_time_constant` above 0, by NAME.
    """
    fmi2, variables = _variables(fmu)
    constants = {}
    for variable in variables:
        name = variable.get("name", "")
        disturbance = name.removesuffix("_time_constant")
        start = _real_attribute(variable, "start", fmi2)
        if disturbance == name or not start:
            continue
        # 0 is a disturbance without memory.
        seconds = float(start)
        if seconds > 0.0:
            constants[disturbance] = seconds
    return constants
