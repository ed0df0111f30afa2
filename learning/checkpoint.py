"""Checkpoints: one file, whole or absent, checked on reading, without pickle.

The file is an NPZ archive of plain arrays. Its entry `run` is JSON: whose state it is, and the
state, where the name of another entry stands for an array. The archive's checksums detect damage.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.files import read_arrays, write_atomically
from learning.errors import CheckpointError

State = dict[str, Any]
"""Arrays, numbers, texts and None by name, or lists and tables of them."""
ENTRY = "array"
"""Only key of a table in the JSON that stands for an array."""


def save(path: Path, run: Mapping[str, Any], state: State) -> Path:
    """Write the state of a run under a temporary name and rename it.

    `run` identifies it. Raises OSError, CheckpointError.
    """
    arrays: dict[str, NDArray[Any]] = {}

    def entry(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        if not isinstance(value, np.ndarray) or value.dtype.hasobject:
            raise CheckpointError(f"a checkpoint holds numbers, texts and arrays, not {value!r}")
        arrays[name := f"{ENTRY} {len(arrays)}"] = value
        return {ENTRY: name}

    document = json.dumps([run, state], default=entry).encode()
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, run=np.frombuffer(document, np.uint8), **arrays)
    return write_atomically(path, stream.getvalue())


def load(path: Path, run: Mapping[str, Any]) -> State:
    """Read the state of a run.

    Raises CheckpointError where the file is missing, damaged or of another run.
    """
    try:
        entries = read_arrays(path)

        def array(table: dict[str, Any]) -> Any:
            return entries[table[ENTRY]] if table.keys() == {ENTRY} else table

        found, state = json.loads(entries["run"].tobytes(), object_hook=array)
        there, state = _flat(dict(found)), dict(state)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path}: there is no checkpoint to resume from; run without --resume"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error
    # Compare both as JSON, where tuples are lists.
    here = _flat(json.loads(json.dumps(run)))
    for key in sorted(there.keys() | here.keys()):
        if there.get(key) != here.get(key):
            raise CheckpointError(
                f"{path}: the checkpoint is of another run: {key} is {there.get(key)!r} there and "
                f"{here.get(key)!r} here; use another --out or the same settings"
            )
    return state


def _flat(run: Mapping[str, Any]) -> dict[str, Any]:
    """Each value by its name, those of an inner table as `table of name`."""
    tables = {key: value for key, value in run.items() if isinstance(value, dict)}
    inner = {f"{key} of {name}": v for key, table in tables.items() for name, v in table.items()}
    return {key: value for key, value in run.items() if key not in tables} | inner


def arrays_of(part: Any) -> State:
    """The state of an object: what its class names in `KEPT`.

    They may be objects of this kind, or with a method `state`. A list becomes an array: JSON is
    slow.
    """
    return {name: _state(getattr(part, name)) for name in part.KEPT}


def take_up(part: Any, state: State) -> None:
    """Restore an object's state from `arrays_of`, in the order of `KEPT`.

    A part with a method `restore` uses it. Raises KeyError where one is missing.
    """
    for name in part.KEPT:
        present, value = getattr(part, name), state[name]
        if hasattr(present, "restore"):
            present.restore(value)
        elif hasattr(present, "KEPT"):
            take_up(present, value)
        else:
            setattr(part, name, list(value) if isinstance(present, list) else deepcopy(value))


def _state(value: Any) -> Any:
    if callable(getattr(value, "state", None)):
        return value.state()
    if isinstance(value, list):
        return np.array(value)
    return arrays_of(value) if hasattr(value, "KEPT") else deepcopy(value)
