"""Checkpoints: one file, whole or absent, checked on reading, without pickle.

The file is an NPZ archive of plain arrays; its entry `about` is JSON (schema version, what the run
is, every number that is no array) and its entry `digest` the SHA-256 of all others.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.files import read_arrays, write_atomically
from learning.errors import CheckpointError

SCHEMA = 7
Array = NDArray[Any]


@dataclass(frozen=True)
class Checkpoint:
    """What a run needs to go on: `run` says which run it is, `state` and `arrays` where it was."""

    run: dict[str, Any]
    state: dict[str, Any]
    arrays: dict[str, Array]


def save(path: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint under a temporary name and rename it; raises OSError."""
    about = {"schema": SCHEMA, "run": checkpoint.run, "state": checkpoint.state}
    entries = dict(checkpoint.arrays)
    entries["about"] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
    for name, array in entries.items():
        if array.dtype.hasobject:
            raise CheckpointError(f"checkpoint entry '{name}' holds Python objects, not numbers")
    entries["digest"] = np.frombuffer(_digest(entries), dtype=np.uint8)
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **entries)
    return write_atomically(path, stream.getvalue())


def load(
    path: Path, run: Mapping[str, Any] | None = None, *, but: Collection[str] = ()
) -> Checkpoint:
    """Read a checkpoint; with `run`, refuse one of a run that differs in more than `but` says.

    Raises CheckpointError where the file is missing, damaged, of another schema or another run.
    """
    entries = _entries(path)
    digest = entries.pop("digest", None)
    if digest is None or "about" not in entries or digest.tobytes() != _digest(entries):
        raise CheckpointError(f"{path}: the checkpoint is damaged (checksum); start the run anew")
    try:
        about = json.loads(entries.pop("about").tobytes())
        if not all(isinstance(part, dict) for part in (about, about["run"], about["state"])):
            raise TypeError("no table")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{path}: the checkpoint says nothing of its run ({error})") from None
    if about.get("schema") != SCHEMA:
        raise CheckpointError(
            f"{path}: schema is {about.get('schema')!r}; this version reads schema {SCHEMA}"
        )
    found: dict[str, Any] = about["run"]
    if run is not None:
        # Both sides through JSON, where tuples are lists.
        there, here = _flat(found), _flat(json.loads(json.dumps(dict(run))))
        for key in sorted((there.keys() | here.keys()) - set(but)):
            if there.get(key) != here.get(key):
                raise CheckpointError(
                    f"{path}: the checkpoint is of another run: {key} is {there.get(key)!r} there "
                    f"and {here.get(key)!r} here; use another --out or the same settings"
                )
    return Checkpoint(found, about["state"], entries)


def _flat(run: Mapping[str, Any]) -> dict[str, Any]:
    """Each value by its name, those of an inner table as `table of name`."""
    tables = {key: value for key, value in run.items() if isinstance(value, dict)}
    inner = {f"{key} of {name}": v for key, table in tables.items() for name, v in table.items()}
    return {key: value for key, value in run.items() if key not in tables} | inner


def prefixed(prefix: str, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Arrays that shall stand beside others, a prefix before each name."""
    return {f"{prefix}{name}": values for name, values in arrays.items()}


def group(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    """What `prefixed` gave, found among others."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def arrays_of(state: Any) -> dict[str, Array]:
    """The fields of a dataclass, each an array or a number, as arrays by name."""
    return {item.name: np.asarray(getattr(state, item.name)) for item in fields(state)}


def take_up(state: Any, arrays: Mapping[str, Array]) -> None:
    """Set a dataclass's fields to what `arrays_of` gave; a number keeps its present type.

    Raises KeyError where one is missing, TypeError or ValueError where it has another form.
    """
    for item in fields(state):
        values, present = arrays[item.name], getattr(state, item.name)
        is_array = isinstance(present, np.ndarray)
        setattr(state, item.name, values if is_array else type(present)(values.item()))


def _entries(path: Path) -> dict[str, Array]:
    try:
        return read_arrays(path)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path}: there is no checkpoint to resume from; run without --resume"
        ) from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error


def _digest(entries: Mapping[str, Array]) -> bytes:
    digest = hashlib.sha256()
    for name in sorted(entries):
        array = np.ascontiguousarray(entries[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(array.tobytes())
    return digest.digest()


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """State of a generator as JSON-ready numbers."""
    state: dict[str, Any] = dict(rng.bit_generator.state)
    return state


def restore_generator(rng: np.random.Generator, state: dict[str, Any]) -> None:
    """Put a generator back; raises CheckpointError where the state is of another kind."""
    try:
        rng.bit_generator.state = state
    except (TypeError, ValueError, KeyError) as error:
        raise CheckpointError(f"the generator's state cannot be restored ({error})") from error
