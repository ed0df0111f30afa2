"""Checkpoints: one file, whole or absent, checked on reading, without pickle.

The file is an NPZ archive of plain arrays; its entry `run` is JSON and says whose they are. The
archive's checksums detect damage.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.files import read_arrays, write_atomically
from learning.errors import CheckpointError

Array = NDArray[Any]


def save(path: Path, run: Mapping[str, Any], arrays: Mapping[str, Array]) -> Path:
    """Write the state of a run under a temporary name and rename it.

    `run` identifies it. Raises OSError, CheckpointError.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise CheckpointError(f"checkpoint entry '{name}' holds Python objects, not numbers")
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, run=as_array(run), **arrays)
    return write_atomically(path, stream.getvalue())


def load(path: Path, run: Mapping[str, Any]) -> dict[str, Array]:
    """Read the arrays of a run.

    Raises CheckpointError where the file is missing, damaged or of another run.
    """
    try:
        entries = read_arrays(path)
        found = from_array(entries.pop("run"))
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path}: there is no checkpoint to resume from; run without --resume"
        ) from error
    except (OSError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error
    # Compare both as JSON, where tuples are lists.
    there, here = _flat(found), _flat(from_array(as_array(run)))
    for key in sorted(there.keys() | here.keys()):
        if there.get(key) != here.get(key):
            raise CheckpointError(
                f"{path}: the checkpoint is of another run: {key} is {there.get(key)!r} there and "
                f"{here.get(key)!r} here; use another --out or the same settings"
            )
    return entries


def as_array(document: Any) -> Array:
    """A JSON document as an array of bytes."""
    return np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)


def from_array(array: Array) -> Any:
    """The JSON document of `as_array`; raises ValueError."""
    return json.loads(array.tobytes())


def _flat(run: Mapping[str, Any]) -> dict[str, Any]:
    """Each value by its name, those of an inner table as `table of name`."""
    tables = {key: value for key, value in run.items() if isinstance(value, dict)}
    inner = {f"{key} of {name}": v for key, table in tables.items() for name, v in table.items()}
    return {key: value for key, value in run.items() if key not in tables} | inner


def prefixed(prefix: str, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Arrays with a prefix before each name."""
    return {f"{prefix}{name}": values for name, values in arrays.items()}


def group(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    """The arrays with a prefix, without it."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def arrays_of(state: Any) -> dict[str, Array]:
    """The state of an object as arrays by name.

    It is made of the attributes that its class names in `KEPT`, or of a dataclass's fields: arrays,
    numbers and lists of arrays; tables of arrays and objects of this kind or with a method `state`,
    whose names follow the attribute's; None is left out.
    """
    found: dict[str, Array] = {}
    for name in _kept(state):
        value = getattr(state, name)
        if callable(getattr(value, "state", None)):
            value = value.state()
        elif _has_parts(value):
            value = arrays_of(value)
        if isinstance(value, dict):
            found |= prefixed(f"{name} ", {key: np.array(part) for key, part in value.items()})
        elif value is not None:
            found[name] = np.array(value)
    return found


def take_up(state: Any, arrays: Mapping[str, Array]) -> None:
    """Restore an object's arrays from `arrays_of`; numbers keep their type.

    In the order of `KEPT`; None stays None; a part with a method `restore` uses it. Raises KeyError
    where one is missing, TypeError or ValueError where it has another form.
    """
    for name in _kept(state):
        present = getattr(state, name)
        if hasattr(present, "restore"):
            present.restore(group(arrays, f"{name} "))
        elif _has_parts(present):
            take_up(present, group(arrays, f"{name} "))
        elif isinstance(present, dict):
            setattr(state, name, group(arrays, f"{name} "))
        elif isinstance(present, np.ndarray | list):
            values = arrays[name].copy()
            setattr(state, name, values if isinstance(present, np.ndarray) else list(values))
        elif present is not None:
            setattr(state, name, type(present)(arrays[name].item()))


def _kept(state: Any) -> Iterable[str]:
    names: Iterable[str] | None = getattr(state, "KEPT", None)
    return [item.name for item in fields(state)] if names is None else names


def _has_parts(value: Any) -> bool:
    return hasattr(value, "KEPT") or is_dataclass(value)
