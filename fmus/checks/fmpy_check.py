"""fmpy: validation of the model description, co-simulation, and model exchange with CVode."""

from __future__ import annotations

from pathlib import Path

import fmpy
import numpy as np
from fmpy.validation import validate_fmu
from numpy.typing import NDArray

from fmus.checks.outcome import NotOfferedError
from fmus.checks.trajectory import experiment, reference, relative_difference, require_identical
from fmus.errors import CheckError

CVODE_TOLERANCE = 1e-10
AGREEMENT = 1e-6


def validate(fmu: Path) -> str:
    """Schema, names, model structure, start values and units of the model description."""
    problems = validate_fmu(str(fmu))
    if problems:
        raise CheckError("; ".join(problems))
    return "no problem found"


def co_simulation(fmu: Path) -> str:
    """`simulate_fmu` must give what a plain loop gives."""
    return require_identical(_simulate(fmu, "CoSimulation"), fmu)


def model_exchange(fmu: Path) -> str:
    """CVode with a tight tolerance must agree with co-simulation to 1e-6 relative."""
    error = relative_difference(
        _simulate(fmu, "ModelExchange", solver="CVode", relative_tolerance=CVODE_TOLERANCE),
        reference(fmu),
    )
    if not error <= AGREEMENT:
        raise CheckError(f"differs from co-simulation by {error:.1e} relative")
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
