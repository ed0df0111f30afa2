"""Solved problems as files: shipped with the package or cached for the user."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.bellman import Accuracy
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.quadrature import DisturbanceLaw
from controllers.dynamic_programming.settings import Settings
from controllers.dynamic_programming.solution import Optimum
from controllers.errors import OptimumError
from controllers.problem import Problem
from controllers.storage import CACHE_VARIABLE, read_arrays, user_cache, write_atomically

Array = NDArray[np.float64]
# Part of every key: raise it when the solver changes what it finds.
VERSION = 1
SHIPPED = Path(__file__).parent.parent / "optima"


def key(problem: Problem, law: DisturbanceLaw, parameters: Array, settings: Settings) -> str:
    """First 16 hexadecimal digits of the SHA-256 of all that the solution depends on.

    That is: the model's equations, physical parameters, sampling, bounds, penalty, reference,
    the disturbance's law, the solver's settings and, for the discounted criterion, γ.
    """
    symbols = problem.model.symbols()
    content: dict[str, Any] = {
        "version": VERSION,
        "ode": _expression(problem.model.ode(*symbols), symbols),
        "cost": _expression(problem.model.economic_cost(*symbols), symbols),
        "time_unit": problem.model.time_unit,
        "sampling_time": problem.sampling_time,
        "discount": 1.0 if settings.criterion == "average" else problem.discount,
        "parameters": parameters.tolist(),
        "law": [law.kind, law.nominal.tolist(), law.ranges.tolist()],
        "settings": asdict(settings),
    }
    for name in (
        "state_lower",
        "state_upper",
        "action_lower",
        "action_upper",
        "penalty_linear",
        "penalty_quadratic",
        "reference_state",
        "reference_action",
    ):
        content[name] = getattr(problem, name).tolist()
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _expression(expression: ca.SX, symbols: tuple[ca.SX, ...]) -> list[str]:
    """An expression's elementary operations, one a line."""
    function = ca.Function("e", list(symbols), [expression])
    lines = []
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        constant = float(function.instruction_constant(k)).hex() if code == ca.OP_CONST else ""
        lines.append(
            f"{code} {function.instruction_input(k)} {function.instruction_output(k)} {constant}"
        )
    return lines


def cache_folder() -> Path:
    """The user's folder of solved problems."""
    return user_cache("optima")


def require_cache() -> Path:
    """The user's folder, made if need be; raises OptimumError where it cannot be written."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        reason = "" if os.access(folder, os.W_OK) else os.strerror(errno.EACCES)
    except OSError as error:
        reason = str(error.strerror)
    if reason:
        raise OptimumError(
            f"{folder}: the optimal policy cannot be kept there ({reason}); name a folder that can "
            f"be written in the environment's {CACHE_VARIABLE}"
        )
    return folder


def stored(name: str) -> Path | None:
    """File of a solved problem by its key: the user's, else shipped, else None."""
    for folder in (cache_folder(), SHIPPED):
        path = folder / f"{name}.npz"
        if path.is_file():
            return path
    return None


def write(path: Path, optimum: Optimum, name: str) -> Path:
    """Write a solved problem as a compressed .npz; equal content gives equal bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    document = {
        "key": name,
        "gain": optimum.gain,
        "lower": optimum.lower,
        "upper": optimum.upper,
        "discount": optimum.discount,
        "accuracy": asdict(optimum.accuracy),
    }
    arrays: dict[str, Any] = {f"axis_{i}": axis for i, axis in enumerate(optimum.grid.axes)}
    arrays |= {
        "actions": optimum.actions,
        "W": optimum.W,
        "distribution": optimum.distribution,
        "document": np.array(json.dumps(document, sort_keys=True)),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return write_atomically(path, buffer.getvalue())


def read(path: Path, name: str) -> Optimum:
    """Read a solved problem; raises OptimumError where the file is damaged or another problem's."""
    mend = "delete it to have the policy computed anew"
    try:
        arrays = read_arrays(path)
        document = json.loads(str(arrays.pop("document")))
        axes = [arrays[f"axis_{i}"] for i in range(sum(e.startswith("axis_") for e in arrays))]
        accuracy = document["accuracy"]
        optimum = Optimum(
            Grid(tuple(axes)),
            arrays["actions"],
            arrays["W"],
            float(document["gain"]),
            float(document["lower"]),
            float(document["upper"]),
            arrays["distribution"],
            float(document["discount"]),
            Accuracy(
                int(accuracy["substeps"]),
                tuple(accuracy["nodes"]),
                tuple(accuracy["penalty_nodes"]),
            ),
        )
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise OptimumError(f"{path}: not a readable optimal policy ({error}); {mend}") from error
    size = optimum.grid.size
    shapes_fit = (
        optimum.actions.ndim == 2
        and optimum.actions.shape[0] == size
        and optimum.W.shape == optimum.distribution.shape == (size,)
    )
    values = (optimum.actions, optimum.W, optimum.distribution)
    if not shapes_fit or not all(np.isfinite(array).all() for array in values):
        raise OptimumError(f"{path}: its arrays do not fit its grid or are not finite; {mend}")
    if document["key"] != name:
        raise OptimumError(
            f"{path}: it holds the policy of problem {document['key']}, not of {name}; {mend}"
        )
    return optimum


def obtain(name: str, make: Callable[[], Optimum]) -> Optimum:
    """Stored solution of the problem with this key, or `make` it and keep it for the user."""
    path = stored(name)
    return renew(name, make) if path is None else read(path, name)


def renew(name: str, make: Callable[[], Optimum]) -> Optimum:
    """`make` the solution of the problem with this key and keep it, whatever is stored.

    Raises OptimumError before it begins where the user's folder cannot be written.
    """
    folder = require_cache()
    optimum = make()
    write(folder / f"{name}.npz", optimum, name)
    return optimum
