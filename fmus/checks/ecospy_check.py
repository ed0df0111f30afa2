"""ecospy (Ecos): a co-simulation master in C++ for FMI 1.0 to 3.0."""

from __future__ import annotations

from pathlib import Path

import fmpy
import numpy as np

from fmus.checks.outcome import require
from fmus.checks.trajectory import experiment, require_identical


def co_simulation(fmu: Path) -> str:
    """Ecos' fixed-step algorithm must give what a plain loop gives."""
    require("ecospy", "ecospy (it needs the system library libtbb12)")
    from ecospy.EcosSimulation import EcosSimulation  # noqa: PLC0415
    from ecospy.EcosSimulationStructure import EcosSimulationStructure  # noqa: PLC0415

    plan = experiment(fmpy.read_model_description(str(fmu)))
    rows = []
    with EcosSimulationStructure() as structure:
        structure.add_model("plant", str(fmu))
        with EcosSimulation(plan.step_size, structure=structure) as simulation:
            simulation.init()
            for k in range(plan.steps + 1):
                if k > 0:
                    simulation.step()
                rows.append([simulation.get_real(f"plant::{name}") for name in plan.names])
    return require_identical(np.array(rows), fmu)
