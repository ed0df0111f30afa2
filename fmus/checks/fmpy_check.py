"""fmpy: validation of the model description, co-simulation, and model exchange with CVode."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.model_description import ModelDescription, ScalarVariable
from fmpy.validation import validate_fmu
from numpy.typing import NDArray

from fmus import CheckError
from fmus.checks.outcome import NotedError, NotOfferedError
from fmus.checks.trajectory import experiment, reference, relative_difference, require_identical

CVODE_TOLERANCE = 1e-10
AGREEMENT = 1e-6
_FMI3_SCALARS = (
    "Float32", "Float64", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64",
    "UInt64", "Boolean", "String",
)  # fmt: skip


def validate(fmu: Path) -> str:
    """Schema, names, model structure, start values and units of the model description."""
    problems = validate_fmu(str(fmu))
    if problems:
        raise CheckError("; ".join(problems))
    return "no problem found"


def declared_variables(fmu: Path) -> str:
    """Every variable that the description declares can be read once the FMU is initialised."""
    description = fmpy.read_model_description(str(fmu))
    face = "CoSimulation" if description.coSimulation is not None else "ModelExchange"
    if description.coSimulation is None and description.modelExchange is None:
        raise NotOfferedError("the FMU has neither co-simulation nor model exchange")
    folder = fmpy.extract(str(fmu))
    try:
        instance = fmpy.instantiate_fmu(folder, description, face)
        version2 = description.fmiVersion.startswith("2")
        if version2:
            instance.setupExperiment(startTime=0.0)
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        for variable in description.modelVariables:
            if version2 or variable.type in _FMI3_SCALARS:
                _read(instance, variable, version2)
        instance.freeInstance()
        token = _accepts_another_token(folder, description, face)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return f"{len(description.modelVariables)} read" + (f"; {token}" if token else "")


def _read(instance: Any, variable: ScalarVariable, version2: bool) -> None:
    type_ = "Integer" if version2 and variable.type == "Enumeration" else variable.type
    reference = [variable.valueReference]
    try:
        if version2 or not variable.dimensions:
            getattr(instance, f"get{type_}")(reference)
    except Exception as error:
        raise CheckError(f"{variable.name} is declared a {variable.type}, but {error}") from error


def _accepts_another_token(folder: str, description: ModelDescription, face: str) -> str:
    """A remark where the FMU does not compare the GUID or instantiation token with its own."""
    description.guid = "{00000000-0000-0000-0000-000000000000}"
    try:
        fmpy.instantiate_fmu(folder, description, face).freeInstance()
    except Exception:
        return ""
    return "it accepts any GUID"


def co_simulation(fmu: Path) -> str:
    """`simulate_fmu` must give what a plain loop gives."""
    return require_identical(_simulate(fmu, "CoSimulation"), fmu)


def model_exchange(fmu: Path) -> str:
    """CVode with a tight tolerance agrees with co-simulation to 1e-6 relative, or it is noted."""
    error = relative_difference(
        _simulate(fmu, "ModelExchange", solver="CVode", relative_tolerance=CVODE_TOLERANCE),
        reference(fmu),
    )
    if not error <= AGREEMENT:
        raise NotedError(
            f"differs from co-simulation by {error:.1e} relative: its own integration is no finer"
        )
    return f"agrees with co-simulation to {error:.1e} relative"


def _simulate(fmu: Path, interface: str, **options: object) -> NDArray[np.float64]:
    description = fmpy.read_model_description(str(fmu))
    if getattr(description, interface[0].lower() + interface[1:]) is None:
        raise NotOfferedError(f"the FMU has no interface {interface}")
    plan = experiment(description)
    result = fmpy.simulate_fmu(
        str(fmu),
        stop_time=plan.stop_time,
        output_interval=plan.step_size,
        output=plan.names,
        fmi_type=interface,
        **options,
    )
    wanted = np.arange(plan.steps + 1) * plan.step_size
    # an event gives two rows of one time: the later one holds the values after it
    last = np.searchsorted(result["time"], wanted + 1e-6 * plan.step_size) - 1
    return np.stack([result[name][last] for name in plan.names], axis=1)
