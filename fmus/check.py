"""Whether an FMU is right: fmpy's validation, its declared variables, a run of its experiment."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.model_description import ModelDescription, ModelVariable
from fmpy.validation import validate_fmu
from numpy.typing import NDArray

from fmus import CheckError, FmuError
from fmus.information import description_of

MAX_STEPS = 500
ROUNDING = 1e-12
"""Relative difference that two ways of counting time may make in the same run."""
_REALS = ("Real", "Float64")
_FMI3_SCALARS = (
    "Float32", "Float64", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64",
    "UInt64", "Boolean", "String",
)  # fmt: skip


class NotOfferedError(FmuError):
    """The FMU or the importer lacks the interface that the check needs."""


@dataclass(frozen=True)
class Finding:
    """What one check found: `status` is "passed", "failed" or "not offered"."""

    subject: str
    status: str
    detail: str


def check(fmu: Path) -> list[Finding]:
    """Check the file `fmu`, whose native code this runs.

    Raises FmuError when the file is missing or is no FMU.
    """
    description_of(fmu)
    checks: dict[str, Callable[[Path], str]] = {
        "model description": validate,
        "declared variables": declared_variables,
        "co-simulation": co_simulation,
    }
    findings = []
    for subject, run in checks.items():
        try:
            status, detail = "passed", run(fmu)
        except NotOfferedError as error:
            status, detail = "not offered", str(error)
        except Exception as error:  # fmpy raises bare Exception
            status, detail = "failed", str(error)
        findings.append(Finding(subject, status, detail))
    return findings


def validate(fmu: Path) -> str:
    """Schema, names, model structure, start values and units of the model description."""
    if problems := validate_fmu(str(fmu)):
        raise CheckError("; ".join(problems))
    return "no problem found"


def declared_variables(fmu: Path) -> str:
    """Every variable that the description declares can be read once the FMU is initialised."""
    description = fmpy.read_model_description(str(fmu), validate=False)
    if description.coSimulation is None and description.modelExchange is None:
        raise NotOfferedError("the FMU has neither co-simulation nor model exchange")
    folder = fmpy.extract(str(fmu))
    try:
        instance = _initialised(folder, description)
        version2 = description.fmiVersion.startswith("2")
        for variable in description.modelVariables:
            if version2 or variable.type in _FMI3_SCALARS:
                _read(instance, variable, version2)
        instance.freeInstance()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return f"{len(description.modelVariables)} read"


def _initialised(folder: str, description: ModelDescription) -> Any:
    face = "CoSimulation" if description.coSimulation is not None else "ModelExchange"
    instance = fmpy.instantiate_fmu(folder, description, face)
    if description.fmiVersion.startswith("2"):
        instance.setupExperiment(startTime=0.0)
    instance.enterInitializationMode()
    instance.exitInitializationMode()
    return instance


def _read(instance: Any, variable: ModelVariable, version2: bool) -> None:
    type_ = "Integer" if version2 and variable.type == "Enumeration" else variable.type
    try:
        if version2 or not variable.dimensions:
            getattr(instance, f"get{type_}")([variable.valueReference])
    except Exception as error:
        raise CheckError(f"{variable.name} is declared a {variable.type}, but {error}") from error


@dataclass(frozen=True)
class Experiment:
    """Step size [s], number of steps and the real scalar outputs to compare."""

    step_size: float
    steps: int
    outputs: tuple[ModelVariable, ...]

    @property
    def names(self) -> list[str]:
        """The outputs' names."""
        return [variable.name for variable in self.outputs]


def experiment(description: ModelDescription) -> Experiment:
    """The default experiment from time zero, at most `MAX_STEPS` long."""
    default = description.defaultExperiment
    stop = float(default.stopTime) if default and default.stopTime else 1.0
    size = float(default.stepSize) if default and default.stepSize else stop / 100
    steps = min(MAX_STEPS, max(1, round(stop / size)))
    outputs = tuple(
        v
        for v in description.modelVariables
        if v.causality == "output" and v.type in _REALS and not v.dimensions
    )
    if not outputs:
        raise NotOfferedError("the FMU has no real output to compare")
    return Experiment(size, steps, outputs)


def reference(fmu: Path) -> NDArray[np.float64]:
    """Outputs (steps + 1, outputs) of a plain doStep loop, start values held."""
    description = fmpy.read_model_description(str(fmu))
    if description.coSimulation is None:
        raise NotOfferedError("the FMU has no co-simulation interface")
    plan = experiment(description)
    folder = fmpy.extract(str(fmu))
    try:
        instance = _initialised(folder, description)
        read = instance.getReal if description.fmiVersion == "2.0" else instance.getFloat64
        references = [variable.valueReference for variable in plan.outputs]
        rows = [list(read(references))]
        for k in range(plan.steps):
            instance.doStep(
                currentCommunicationPoint=k * plan.step_size,
                communicationStepSize=plan.step_size,
            )
            rows.append(list(read(references)))
        instance.terminate()
        instance.freeInstance()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return np.array(rows)


def simulated(fmu: Path, interface: str, **options: object) -> NDArray[np.float64]:
    """The same outputs by fmpy's `simulate_fmu`."""
    description = fmpy.read_model_description(str(fmu))
    if getattr(description, interface[0].lower() + interface[1:]) is None:
        raise NotOfferedError(f"the FMU has no interface {interface}")
    plan = experiment(description)
    result = fmpy.simulate_fmu(
        str(fmu),
        stop_time=plan.steps * plan.step_size,
        output_interval=plan.step_size,
        output=plan.names,
        fmi_type=interface,
        **options,
    )
    wanted = np.arange(plan.steps + 1) * plan.step_size
    # An event gives two rows of one time: the later one holds the values after it.
    last = np.searchsorted(result["time"], wanted + 1e-6 * plan.step_size) - 1
    return np.stack([result[name][last] for name in plan.names], axis=1)


def co_simulation(fmu: Path) -> str:
    """`simulate_fmu` gives the finite outputs of a plain loop, but for rounding."""
    return require_equal(simulated(fmu, "CoSimulation"), fmu, ROUNDING)


def require_equal(rows: NDArray[np.float64], fmu: Path, tolerance: float = 0.0) -> str:
    """A detail where `rows` are the last of `reference`, relative difference ≤ `tolerance`.

    Raises CheckError where they are not, or not finite.
    """
    expected = reference(fmu)[-len(rows) :]
    if not np.isfinite(expected).all():
        raise CheckError("an output is not finite")
    error = relative_difference(rows, expected)
    if not error <= tolerance:
        raise CheckError(f"differs from a plain doStep loop by up to {error:.1e} relative")
    agreement = "bit-identical" if error == 0.0 else f"equal to {error:.1e}"
    return f"{len(rows)} points of {rows.shape[1]} outputs, {agreement}"


def relative_difference(rows: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    """Largest difference relative to the expected value, but at least to 0.1 % of its signal."""
    scale = np.maximum(np.abs(expected), 1e-3 * np.max(np.abs(expected), axis=0))
    return float(np.max(np.abs(rows - expected) / np.maximum(scale, np.finfo(float).tiny)))
