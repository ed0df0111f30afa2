"""libcosimpy (Open Simulation Platform's libcosim over FMI Library): FMI 2.0."""

from __future__ import annotations

from pathlib import Path

import fmpy
import numpy as np

from fmus.checks.outcome import NotOfferedError, require
from fmus.checks.trajectory import experiment, require_identical


def co_simulation(fmu: Path) -> str:
    """Libcosim's fixed-step algorithm must give what a plain loop gives."""
    require("libcosimpy.CosimExecution", "libcosimpy")
    from libcosimpy.CosimExecution import CosimExecution  # noqa: PLC0415
    from libcosimpy.CosimObserver import CosimObserver  # noqa: PLC0415
    from libcosimpy.CosimSlave import CosimLocalSlave  # noqa: PLC0415

    description = fmpy.read_model_description(str(fmu))
    if description.fmiVersion != "2.0":
        raise NotOfferedError("libcosim imports FMI 1.0 and 2.0 only")
    plan = experiment(description)
    execution = CosimExecution.from_step_size(round(plan.step_size * 1e9))  # nanoseconds
    slave = CosimLocalSlave(fmu_path=str(fmu), instance_name="plant")
    index = execution.add_local_slave(slave)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    references = [variable.valueReference for variable in plan.outputs]
    rows = []
    for _ in range(plan.steps):
        execution.step()
        rows.append(list(observer.last_real_values(index, references)))
    return require_identical(np.array(rows), fmu)
