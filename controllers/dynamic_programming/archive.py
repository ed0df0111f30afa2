"""Solved problems as files: shipped with the package or cached for the user."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from controllers.dynamic_programming.bellman import Accuracy
from controllers.dynamic_programming.certificate import Certificate
from controllers.dynamic_programming.grid import Grid
from controllers.dynamic_programming.plant import PlantProblem
from controllers.dynamic_programming.settings import Settings
from controllers.dynamic_programming.solution import Optimum
from controllers.errors import OptimumError
from controllers.problem import Problem
from cosim.cache import CACHE_VARIABLE, is_closed, is_own_file, own_folder, user_cache
from cosim.files import read_arrays, write_atomically

# Part of every key: raise it when the solver changes what it finds.
VERSION = 2
MEND = "delete it to have the policy computed anew"
KIND = "optima"
SHIPPED = Path(__file__).parent.parent / "optima"


def key(plant: PlantProblem, settings: Settings) -> str:
    """First 16 hexadecimal digits of the SHA-256 of all that the solution depends on.

    That is: the model's equations, physical parameters, sampling, bounds, penalty, reference,
    the disturbance's law, the solver's settings and, for the discounted criterion, γ.
    """
    problem, law, parameters = plant.problem, plant.law, plant.parameters
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
    return user_cache(KIND)


def require_cache() -> Path:
    """The user's folder, made if need be; OptimumError where it is not the user's or is closed."""
    try:
        return own_folder(KIND)
    except OSError as error:
        raise OptimumError(
            f"{cache_folder()}: the optimal policy cannot be kept there ({error.strerror}); name a "
            "folder that can be written, by its user only, in the environment's "
            f"{CACHE_VARIABLE}"
        ) from None


def stored(name: str) -> Path | None:
    """File of a solved problem by its key: the package's own, else the user's, else None.

    A folder that others can write is left alone.
    """
    path = SHIPPED / f"{name}.npz"
    if path.is_file():
        return path
    path = cache_folder() / path.name
    return path if is_closed(path.parent) and is_own_file(path) else None


def write(path: Path, optimum: Optimum, name: str) -> Path:
    """Write a solved problem as a compressed .npz; equal content gives equal bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    certificate = optimum.certificate
    document: dict[str, Any] = {
        "key": name,
        "gain": optimum.gain,
        "lower": optimum.lower,
        "upper": optimum.upper,
        "discount": optimum.discount,
        "accuracy": asdict(optimum.accuracy),
        "smooth": optimum.grid.smooth,
        "certificate": None if certificate is None else certificate.to_list(),
    }
    arrays: dict[str, Any] = {f"axis_{i}": axis for i, axis in enumerate(optimum.grid.axes)}
    arrays |= {name: getattr(optimum, name) for name in ("actions", "W", "distribution")}
    document["sha256"] = _checksum(document, arrays)
    arrays["document"] = np.array(json.dumps(document, sort_keys=True))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return write_atomically(path, buffer.getvalue())


def _checksum(document: dict[str, Any], arrays: dict[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def read(path: Path, name: str, problem: Problem) -> Optimum:
    """Read a solved problem and check that it can be one of `problem`.

    Raises OptimumError where the file is damaged or another problem's, where its checksum does not
    fit, or where its bounds, its distribution or its actions are none.
    """
    try:
        arrays = read_arrays(path)
        document = json.loads(str(arrays.pop("document")))
        checksum = document.pop("sha256")
        axes = [arrays[f"axis_{i}"] for i in range(sum(e.startswith("axis_") for e in arrays))]
        accuracy, figures = document["accuracy"], document["certificate"]
        smooth = document["smooth"]
        optimum = Optimum(
            Grid(tuple(axes), smooth and tuple((float(a), float(b)) for a, b in smooth)),
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
            None if figures is None else Certificate.from_list(figures),
        )
        fits = checksum == _checksum(document, arrays)
        stored_name = document["key"]
    except (OSError, KeyError, TypeError, ValueError, AttributeError, OptimumError) as error:
        raise OptimumError(f"{path}: not a readable optimal policy ({error}); {MEND}") from error
    if not fits:
        raise OptimumError(f"{path}: its checksum does not fit its content; {MEND}")
    if reason := _unsound(optimum, problem):
        raise OptimumError(f"{path}: {reason}; {MEND}")
    if stored_name != name:
        raise OptimumError(
            f"{path}: it holds the policy of problem {stored_name}, not of {name}; {MEND}"
        )
    return optimum


def _unsound(optimum: Optimum, problem: Problem) -> str | None:
    """Why an optimum cannot be one of the problem, None where it can."""
    size, numbers = optimum.grid.size, (optimum.lower, optimum.gain, optimum.upper)
    arrays = (optimum.actions, optimum.W, optimum.distribution)
    if not all(array.dtype == np.float64 and np.isfinite(array).all() for array in arrays):
        return "its arrays are not finite numbers"
    if (
        len(optimum.grid.axes) != problem.n_states
        or optimum.actions.shape != (size, problem.n_actions)
        or not optimum.W.shape == optimum.distribution.shape == (size,)
    ):
        return "its arrays do not fit its grid or the problem"
    ordered = optimum.discount < 1.0 or numbers[0] <= numbers[1] <= numbers[2]
    if not (all(map(isfinite, numbers)) and numbers[0] <= numbers[2] and ordered):
        return f"its bounds {numbers[0]} and {numbers[2]} do not enclose its gain {numbers[1]}"
    if (optimum.distribution < 0).any() or not optimum.distribution.sum() > 0:
        return "its distribution is none"
    rounding = 1e-9 * (problem.action_upper - problem.action_lower)
    if (
        (optimum.actions < problem.action_lower - rounding)
        | (optimum.actions > problem.action_upper + rounding)
    ).any():
        return "it has actions beyond their bounds"
    return None


def obtain(name: str, problem: Problem, make: Callable[[], Optimum]) -> Optimum:
    """Stored solution of the problem with this key, or `make` it and keep it for the user."""
    path = stored(name)
    return keep(name, make) if path is None else read(path, name, problem)


def keep(name: str, make: Callable[[], Optimum]) -> Optimum:
    """`make` the solution of the problem with this key and keep it in the user's folder.

    Raises OptimumError before it begins where the folder cannot be written.
    """
    folder = require_cache()
    optimum = make()
    write(folder / f"{name}.npz", optimum, name).chmod(0o600)
    return optimum
