"""Checkpoints of a training: one file, whole or absent, checked on reading, without pickle.

The file is an NPZ archive: an entry for each array or number of the run's `state_dict`, and in the
entry `run` JSON that says whose state it is. The archive's checksums detect damage.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.files import read_arrays, write_atomically
from learning.errors import CheckpointError

State = dict[str, Any]
"""A `state_dict`: arrays and numbers by name. Names of a part begin with the part's and a dot."""
RUN = "run"
"""Entry of the archive that identifies the run."""
STATE = "state"
"""Prefix of the entries of the state."""


def save(
    path: Path,
    run: Mapping[str, Any],
    state: State,
) -> Path:
    """Write the state of a run under a temporary name and rename it.

    Args:
        path: the checkpoint's file.
        run: what identifies the run, JSON-ready.
        state: arrays and numbers by name.

    Returns:
        The path.

    Raises:
        CheckpointError: a value is neither an array nor a number.
        OSError: the file cannot be written.
    """
    # A prefix keeps the state apart from the entry of the run.
    entries: dict[str, NDArray[Any]] = {}
    for name, value in prefixed(STATE, state).items():
        # A text or an object would need pickle, which runs what it reads.
        array = np.asarray(value)
        if array.dtype.hasobject or array.dtype.kind in "US":
            raise CheckpointError(f"a state_dict holds arrays and numbers; {name} is {value!r}")
        entries[name] = array
    document = json.dumps(run).encode()
    entries[RUN] = np.frombuffer(document, np.uint8)
    # Whole or absent: the file is renamed once it is complete.
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **entries)
    return write_atomically(path, stream.getvalue())


def load(path: Path, run: Mapping[str, Any]) -> State:
    """Read the state of a run.

    Args:
        path: the checkpoint's file.
        run: what identifies the run that is to go on.

    Returns:
        What `save` was given, numbers as Python's.

    Raises:
        CheckpointError: the file is missing, damaged or of another run.
    """
    try:
        entries = read_arrays(path)
        document = entries[RUN].tobytes()
        stored = _flat(dict(json.loads(document)))
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path}: there is no checkpoint to resume from; run without --resume"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error
    _refuse_another_run(path, stored, run)
    # NumPy reads a number as an array without dimensions.
    state: State = {}
    for name, array in part_of(entries, STATE).items():
        state[name] = array.item() if array.ndim == 0 else array
    return state


def prefixed(prefix: str, state: Mapping[str, Any]) -> State:
    """The state of a part under the part's name.

    Args:
        prefix: the part's name.
        state: its arrays and numbers by name.

    Returns:
        The same values, each by `prefix.name`.
    """
    return {f"{prefix}.{name}": value for name, value in state.items()}


def part_of(state: Mapping[str, Any], prefix: str) -> State:
    """The state of a part out of that of the whole; the inverse of `prefixed`.

    Args:
        state: arrays and numbers by name.
        prefix: the part's name.

    Returns:
        The values whose names begin with `prefix.`, by the rest of their names.
    """
    start = f"{prefix}."
    part: State = {}
    for name, value in state.items():
        if name.startswith(start):
            part[name.removeprefix(start)] = value
    return part


def generator_state(rng: np.random.Generator) -> NDArray[np.uint64]:
    """State of a PCG64 generator as six words: two numbers of 128 bits, and a 32-bit draw left."""
    state: Any = rng.bit_generator.state
    long_numbers = state["state"]
    # NumPy has no integers of 128 bits.
    words = []
    for number in (long_numbers["state"], long_numbers["inc"]):
        high = number >> 64
        low = number % 2**64
        words += [high, low]
    words += [state["has_uint32"], state["uinteger"]]
    return np.array(words, np.uint64)


def set_generator_state(rng: np.random.Generator, words: NDArray[np.uint64]) -> None:
    """Put a PCG64 generator back.

    Args:
        rng: the generator.
        words: what `generator_state` returned, (6,).
    """
    high, low, increment_high, increment_low, has_uint32, uinteger = words.tolist()
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {
            "state": high << 64 | low,
            "inc": increment_high << 64 | increment_low,
        },
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }


def _refuse_another_run(
    path: Path,
    stored: Mapping[str, Any],
    run: Mapping[str, Any],
) -> None:
    """Raise CheckpointError by the first field that differs; `stored` is flat already."""
    # Compare both as JSON, where tuples are lists.
    document = json.dumps(run)
    wanted = _flat(json.loads(document))
    keys = stored.keys() | wanted.keys()
    for key in sorted(keys):
        if stored.get(key) != wanted.get(key):
            raise CheckpointError(
                f"{path}: the checkpoint is of another run: {key} is {stored.get(key)!r} there and "
                f"{wanted.get(key)!r} here; use another --out or the same settings"
            )


def _flat(run: Mapping[str, Any]) -> dict[str, Any]:
    """Each value by its name, those of an inner table as `name of table`."""
    flat: dict[str, Any] = {}
    for key, value in run.items():
        if isinstance(value, dict):
            for name, inner in value.items():
                flat[f"{name} of {key}"] = inner
        else:
            flat[key] = value
    return flat
