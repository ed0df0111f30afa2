"""Independent FMI importers run an FMU: python -m benchmarks.importers TOOL SUBJECT FILE.

Native importers write to the console and may crash: each check is a process of its own, whose
last line is its finding as JSON.
"""

from __future__ import annotations

import importlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.model_description import ModelDescription, ModelVariable
from numpy.typing import NDArray

from fmus import CheckError, FmuError
from fmus.check import NotOfferedError, declared_variables, information, validate

TIMEOUT = 300.0  # s for one importer
JUDGES = ("fmpy", "fmutool")
"""Tools whose failure is the FMU's; any other may be unable."""
WORDS = 200  # last characters of what a crashed importer said
AGREEMENT = 1e-6
MAX_STEPS = 500
_REALS = ("Real", "Float64")
PASSED, FAILED, NOTED, CANNOT = "passed", "failed", "noted", "importer cannot"
NOT_INSTALLED, NOT_OFFERED = "not installed", "not offered"


@dataclass(frozen=True)
class Finding:
    """Which tool looked at what, and what it found.

    `FAILED` says that the FMU is wrong; `CANNOT` that the importer does not do with it what
    others do; `NOTED` what is worth knowing and no fault.
    """

    tool: str
    subject: str
    status: str
    detail: str


class NotedError(FmuError):
    """A finding that is worth a line but no fault of the FMU."""


class NotInstalledError(FmuError):
    """The importer, or a library that it needs, is not there."""


def require(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        raise NotInstalledError(f"{module} does not load: {error}") from error


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


def initialised(folder: str, description: ModelDescription) -> Any:
    """A co-simulation instance of the unpacked FMU after initialisation."""
    instance = fmpy.instantiate_fmu(folder, description, "CoSimulation")
    if description.fmiVersion.startswith("2"):
        instance.setupExperiment(startTime=0.0)
    instance.enterInitializationMode()
    instance.exitInitializationMode()
    return instance


def reference(fmu: Path) -> NDArray[np.float64]:
    """Outputs (steps + 1, outputs) of a plain doStep loop, start values held."""
    description = fmpy.read_model_description(str(fmu))
    if description.coSimulation is None:
        raise NotOfferedError("the FMU has no co-simulation interface")
    plan = experiment(description)
    folder = fmpy.extract(str(fmu))
    try:
        instance = initialised(folder, description)
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


def fmpy_co_simulation(fmu: Path) -> str:
    return require_equal(simulated(fmu, "CoSimulation"), fmu)


def model_exchange(fmu: Path) -> str:
    """CVode with a tight tolerance agrees with co-simulation to 1e-6 relative, or it is noted."""
    rows = simulated(fmu, "ModelExchange", solver="CVode", relative_tolerance=1e-10)
    error = relative_difference(rows, reference(fmu))
    if not error <= AGREEMENT:
        raise NotedError(
            f"differs from co-simulation by {error:.1e} relative: its own integration is no finer"
        )
    return f"agrees with co-simulation to {error:.1e} relative"


def ecos(fmu: Path) -> str:
    """Ecos' fixed-step algorithm (C++, FMI 1.0 to 3.0) gives what a plain loop gives."""
    simulations = require("ecospy.EcosSimulation")
    structures = require("ecospy.EcosSimulationStructure")
    plan = experiment(fmpy.read_model_description(str(fmu)))
    rows = []
    with structures.EcosSimulationStructure() as structure:
        structure.add_model("plant", str(fmu))
        with simulations.EcosSimulation(plan.step_size, structure=structure) as simulation:
            simulation.init()
            for k in range(plan.steps + 1):
                if k > 0:
                    simulation.step()
                rows.append([simulation.get_real(f"plant::{name}") for name in plan.names])
    return require_equal(np.array(rows), fmu)


def libcosim(fmu: Path) -> str:
    """Libcosim's fixed-step algorithm (over FMI Library) gives what a plain loop gives."""
    executions = require("libcosimpy.CosimExecution")
    observers = require("libcosimpy.CosimObserver")
    slaves = require("libcosimpy.CosimSlave")
    description = fmpy.read_model_description(str(fmu))
    if description.fmiVersion != "2.0":
        raise NotOfferedError("libcosim imports FMI 1.0 and 2.0 only")
    plan = experiment(description)
    execution = executions.CosimExecution.from_step_size(round(plan.step_size * 1e9))  # ns
    slave = slaves.CosimLocalSlave(fmu_path=str(fmu), instance_name="plant")
    index = execution.add_local_slave(slave)
    observer = observers.CosimObserver.create_last_value()
    execution.add_observer(observer)
    references = [variable.valueReference for variable in plan.outputs]
    rows = []
    for _ in range(plan.steps):
        execution.step()
        rows.append(list(observer.last_real_values(index, references)))
    return require_equal(np.array(rows), fmu)


def conformity(fmu: Path) -> str:
    """`fmutool -check` of the FMU Manipulation Toolbox logs neither an error nor a warning."""
    require("fmu_manipulation_toolbox")
    program = "from fmu_manipulation_toolbox.cli.fmutool import fmutool; fmutool()"
    command = [sys.executable, "-c", program, "-input", str(fmu), "-check"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    output = result.stdout + result.stderr
    bad = [
        line for line in output.splitlines() if line.startswith(("ERROR", "WARNING", "CRITICAL"))
    ]
    if result.returncode != 0 or bad:
        raise CheckError("; ".join(bad) or f"fmutool ended with code {result.returncode}")
    found = [line.split("|")[-1].strip() for line in output.splitlines() if "compliant" in line]
    return " ".join(found) or "no problem found"


def jacobian(fmu: Path) -> str:
    """CasADi: ∂(ẋ, y)/∂(x, u) at the start point agrees with central differences to 1e-6."""
    casadi = require("casadi")
    casadi.GlobalOptions.setNumpyMode(-1)
    if fmpy.read_model_description(str(fmu)).modelExchange is None:
        raise NotOfferedError("the FMU has no model-exchange interface")
    flags = information(fmu)["flags"]["model exchange"]
    if "true" not in {v for k, v in flags.items() if k.startswith("providesDirectional")}:
        raise NotOfferedError("the FMU provides no directional derivatives")
    folder = fmpy.extract(str(fmu))
    try:
        dae = casadi.DaeBuilder("check", str(folder))
        if dae.nx() == 0:
            raise NotOfferedError("the FMU has no continuous states")
        names = dae.x()
        start = fmpy.simulate_fmu(
            str(fmu), stop_time=1e-3, output_interval=1e-3, output=names, fmi_type="ModelExchange"
        )
        point = [
            np.array([start[name][0] for name in names]),
            np.array(dae.start(dae.u()), dtype=float),
        ]
        exact, numeric = _jacobians(casadi, dae, point)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    error = float(np.max(np.abs(exact - numeric) / np.maximum(1.0, np.abs(numeric))))
    if not error <= AGREEMENT:
        raise CheckError(f"Jacobian differs from finite differences by {error:.1e}")
    rows, columns = exact.shape
    return f"{rows} × {columns} Jacobian agrees with finite differences to {error:.1e}"


def _jacobians(
    casadi: Any, dae: Any, point: list[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    outputs = ["ode", "y"] if dae.ny() else ["ode"]
    inputs = ["x", "u"] if dae.nu() else ["x"]
    function = dae.create("f", inputs, outputs)

    def evaluate(values: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        result = function(**dict(zip(inputs, values, strict=False)))
        return np.concatenate([np.array(result[name]).ravel() for name in outputs])

    symbols = dict(
        zip(
            inputs,
            [casadi.MX.sym("x", dae.nx()), casadi.MX.sym("u", dae.nu())],
            strict=False,
        )
    )
    stacked = casadi.vertcat(*[function(**symbols)[name] for name in outputs])
    both = casadi.vertcat(*symbols.values())
    exact = casadi.Function("J", list(symbols.values()), [casadi.jacobian(stacked, both)])
    columns = []
    for i, block in enumerate(point[: len(inputs)]):
        for j in range(len(block)):
            h = 1e-6 * max(1.0, abs(block[j]))
            shifted = [[b.copy() for b in point] for _ in range(2)]
            shifted[0][i][j] += h
            shifted[1][i][j] -= h
            columns.append((evaluate(shifted[0]) - evaluate(shifted[1])) / (2 * h))
    return np.array(exact(*point[: len(inputs)])), np.array(columns).T


CHECKS: dict[tuple[str, str], Callable[[Path], str]] = {
    ("fmpy", "validation"): validate,
    ("fmpy", "declared variables"): declared_variables,
    ("fmpy", "co-simulation"): fmpy_co_simulation,
    ("fmpy", "model exchange, CVode"): model_exchange,
    ("casadi", "model exchange, Jacobian"): jacobian,
    ("ecospy", "co-simulation"): ecos,
    ("libcosimpy", "co-simulation"): libcosim,
    ("fmutool", "conformity"): conformity,
}
_STATUS = {NotInstalledError: NOT_INSTALLED, NotOfferedError: NOT_OFFERED, NotedError: NOTED}


def check(fmu: Path) -> list[Finding]:
    """Check the file `fmu` with every importer, in the order of `CHECKS`."""
    return [_in_own_process(tool, subject, fmu) for tool, subject in CHECKS]


def _in_own_process(tool: str, subject: str, fmu: Path) -> Finding:
    blame = FAILED if tool in JUDGES else CANNOT
    command = [sys.executable, "-m", "benchmarks.importers", tool, subject, str(fmu.resolve())]
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(tool, subject, blame, f"no result after {TIMEOUT:.0f} s")
    lines = result.stdout.splitlines()
    if result.returncode != 0 or not lines:
        words = " ".join(result.stderr.split())[-WORDS:]
        return Finding(tool, subject, blame, f"ended with code {result.returncode}: {words}")
    status, detail = json.loads(lines[-1])
    return Finding(tool, subject, status, detail)


def run(tool: str, subject: str, fmu: Path) -> tuple[str, str]:
    """Status and detail of one check in this process."""
    try:
        return PASSED, CHECKS[tool, subject](fmu)
    except FmuError as error:
        return _STATUS.get(type(error), FAILED), str(error)
    except Exception as error:
        return FAILED if tool in JUDGES else CANNOT, f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    print("\n" + json.dumps(run(sys.argv[1], sys.argv[2], Path(sys.argv[3]))))
