"""CasADi's FMU importer: its Jacobian (from directional derivatives) against finite differences."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from numpy.typing import NDArray

from fmus import CheckError
from fmus.checks.outcome import NotOfferedError, require
from fmus.information import information

AGREEMENT = 1e-6


def jacobian(fmu: Path) -> str:
    """∂(ẋ, y)/∂(x, u) at the start point must agree with central differences to 1e-6."""
    casadi = require("casadi", "casadi")
    casadi.GlobalOptions.setNumpyMode(-1)
    description = fmpy.read_model_description(str(fmu))
    if description.modelExchange is None:
        raise NotOfferedError("the FMU has no model-exchange interface")
    flags = information(fmu).flags["model exchange"]
    if "true" not in {v for k, v in flags.items() if k.startswith("providesDirectional")}:
        raise NotOfferedError("the FMU provides no directional derivatives")
    folder = fmpy.extract(str(fmu))
    try:
        dae = casadi.DaeBuilder("check", str(folder))
        if dae.nx() == 0:
            raise NotOfferedError("the FMU has no continuous states")
        point = [_initial_states(fmu, dae.x()), np.array(dae.start(dae.u()), dtype=float)]
        exact, numeric = _jacobians(casadi, dae, point)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    error = float(np.max(np.abs(exact - numeric) / np.maximum(1.0, np.abs(numeric))))
    if not error <= AGREEMENT:
        raise CheckError(f"Jacobian differs from finite differences by {error:.1e}")
    rows, columns = exact.shape
    return f"{rows} × {columns} Jacobian agrees with finite differences to {error:.1e}"


def _initial_states(fmu: Path, names: list[str]) -> NDArray[np.float64]:
    result = fmpy.simulate_fmu(
        str(fmu), stop_time=1e-3, output_interval=1e-3, output=names, fmi_type="ModelExchange"
    )
    return np.array([result[name][0] for name in names])


def _jacobians(
    casadi: Any, dae: Any, point: list[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    outputs = ["ode", "y"] if dae.ny() else ["ode"]
    inputs = ["x", "u"] if dae.nu() else ["x"]
    function = dae.create("f", inputs, outputs)

    def evaluate(values: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        result = function(**dict(zip(inputs, values, strict=False)))
        return np.concatenate([np.array(result[name]).ravel() for name in outputs])

    x = casadi.MX.sym("x", dae.nx())
    u = casadi.MX.sym("u", dae.nu())
    symbols = dict(zip(inputs, [x, u], strict=False))
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
