"""What makes an FMU no plant, whatever scenario it is for."""

from __future__ import annotations

from collections.abc import Iterator

from cosim.errors import PlantError
from cosim.plant.archive import UnpackedFmu
from cosim.plant.library import library_path

_REAL = ("Real", "Float64")


def refusals(fmu: UnpackedFmu) -> Iterator[str]:
    """Every reason for which `FmuPlant` refuses the FMU, as its error message says it."""
    description, name = fmu.description, f"FMU '{fmu.path}'"
    simulation = description.coSimulation
    if simulation is None:
        others = [
            words
            for words, face in (
                ("model exchange", description.modelExchange),
                ("scheduled execution", description.scheduledExecution),
            )
            if face is not None
        ]
        yield f"{name} has no co-simulation interface (it has: {', '.join(others) or 'none'})"
    else:
        if simulation.needsExecutionTool:
            yield (
                f"{name} needs the tool that made it to run (needsExecutionTool); export it as an "
                "FMU that stands alone"
            )
        try:
            library_path(fmu)
        except PlantError as error:
            yield str(error)
    scalars = [v for v in description.modelVariables if v.type in _REAL and not v.dimensions]
    if not any(v.causality == "input" or v.variability == "tunable" for v in scalars):
        yield (
            f"{name} has no scalar real input and no tunable parameter: there is nothing for a "
            "controller to act on"
        )
    if not any(v.causality in ("output", "local") for v in scalars):
        yield f"{name} has no scalar real output: there is nothing for a controller to see"


def check_step(fmu: UnpackedFmu, sampling_time: float) -> None:
    """Raise PlantError where the FMU's communication step is fixed and not the sampling time [s].

    Such an FMU steps by the step size of its default experiment (FMI 2.0), or by a multiple of
    its fixed internal step (FMI 3.0).
    """
    simulation, name = fmu.description.coSimulation, f"FMU '{fmu.path}'"
    internal = simulation.fixedInternalStepSize
    if internal is not None and float(internal) > 0:
        count = sampling_time / float(internal)
        if round(count) < 1 or abs(count - round(count)) > 1e-9 * count:
            raise PlantError(
                f"{name} steps by multiples of {float(internal):g} s (fixedInternalStepSize), and "
                f"the sampling time of {sampling_time:g} s is none"
            )
    if simulation.canHandleVariableCommunicationStepSize:
        return
    experiment = fmu.description.defaultExperiment
    size = getattr(experiment, "stepSize", None)
    if size is None or internal is not None:
        return
    if abs(float(size) - sampling_time) > 1e-9 * sampling_time:
        raise PlantError(
            f"{name} steps by {float(size):g} s alone (canHandleVariableCommunicationStepSize is "
            f"false), but the sampling time is {sampling_time:g} s"
        )
