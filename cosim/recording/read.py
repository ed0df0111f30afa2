"""Reads a recording back: signals with every bit, units, and the run's properties."""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import RerunWarning

from cosim.errors import RecordingError
from cosim.scenario import VIOLATING

TIME, SAMPLE = "time", "sample"
SIGNAL = "cosim.Signal"
"""Archetype of the static mark (name, unit) on every entity that holds a signal."""
_SCALARS = rr.Scalars.descriptor_scalars().component
_STATUS = rr.StateChange.descriptor_state().component


@dataclass(frozen=True)
class Recording:
    """Content of a recording.

    `signals` maps a signal's name to its values, (K,) float64, or (K, N) for a prediction
    (`prediction/<name>`) and a block of θ (`increment/<block>`); `samples` (K,) are the numbers of
    their rows and `time` (K,) the plant's time in s (NaN where there is none); `units` and
    `properties` are text; `status` (K,) is the solver's status, empty if it was not recorded.
    `intermediate` maps a state's name to times [s] and values within the samples, (M, 2).
    """

    signals: dict[str, NDArray[np.float64]]
    samples: NDArray[np.int64]
    time: NDArray[np.float64]
    units: dict[str, str]
    properties: dict[str, str]
    status: list[str]
    intermediate: dict[str, NDArray[np.float64]]


def read_recording(path: str | Path) -> Recording:
    """Read a `.rrd` file that this package wrote.

    Raises RecordingError where there is no such file, or it is no recording of this package.
    """
    static: dict[str, dict[str, list[str]]] = {}
    rows: dict[str, list[pa.RecordBatch]] = defaultdict(list)
    for chunk in _chunks(Path(path)):
        batch = chunk.to_record_batch()
        if chunk.is_static:
            texts = {name: _texts(batch.column(name)) for name in batch.schema.names}
            static.setdefault(chunk.entity_path, {}).update(texts)
        elif SAMPLE in batch.schema.names:
            rows[chunk.entity_path].append(batch)
    marks = {entity: texts for entity, texts in static.items() if f"{SIGNAL}:name" in texts}
    if not marks:
        raise RecordingError(f"{path} holds no signals of rti-cosim")
    signals: dict[str, NDArray[np.float64]] = {}
    units: dict[str, str] = {}
    intermediate: dict[str, NDArray[np.float64]] = {}
    samples, time = np.empty(0, np.int64), np.empty(0)
    for entity, texts in marks.items():
        names, spelled = texts[f"{SIGNAL}:name"], texts.get(f"{SIGNAL}:unit", [])
        if len(names) != len(spelled):
            raise RecordingError(f"{path} was recorded by another version of rti-cosim")
        units |= dict(zip(names, spelled, strict=True))
        found, values = _columns(rows[entity], len(names))
        if entity.startswith("/intermediate/"):
            moments = np.column_stack([_time(rows[entity]), *values])
            intermediate[names[0]] = moments[moments[:, 0].argsort(kind="stable")]
            continue
        signals |= dict(zip(names, values, strict=True))
        if len(found) > len(samples):
            samples, time = found, _time(rows[entity])
    described = next((t for e, t in static.items() if e.endswith("/run")), {})
    properties = {key: text[0] for key, text in described.items() if ":" not in key and text}
    properties.pop("rerun.controls.RowId", None)
    status = _status(rows.get("/solver/status", []), samples)
    signals = dict(sorted(signals.items()))
    return Recording(signals, samples, time, units, properties, status, intermediate)


def worst_moment(path: str | Path) -> float | None:
    """Time in s (training: sample) of the worst violation, or of the end; None if unreadable."""
    try:
        recording = read_recording(path)
    except RecordingError:
        return None
    if not len(recording.samples):
        return None
    where = np.where(np.isfinite(recording.time), recording.time, recording.samples)
    violation = recording.signals.get("violation", np.zeros(1))
    violates = np.nanmax(violation, initial=0.0) > VIOLATING
    return float(where[int(np.nanargmax(violation)) if violates else -1])


def summarise(path: str | Path) -> dict[str, Any]:
    """Return what a recording holds, ready for JSON: properties, and each signal's unit and range.

    Raises RecordingError as `read_recording` does.
    """
    recording = read_recording(path)
    signals = {}
    for name, values in recording.signals.items():
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (None, None)
        signals[name] = {"unit": recording.units[name], "minimum": low, "maximum": high}
    return {
        "properties": recording.properties,
        "samples": len(recording.samples),
        "signals": signals,
        "statuses": dict(sorted(Counter(recording.status).items())),
    }


def _chunks(path: Path) -> list[Chunk]:
    try:
        if not path.is_file():
            raise RecordingError(f"there is no recording {path}")
        with warnings.catch_warnings():
            # A file without its end is reported below, once.
            warnings.simplefilter("ignore", RerunWarning)
            return RrdReader(path).stream().to_chunks()
    except (ValueError, RuntimeError, OSError) as error:
        raise RecordingError(
            f"{path} is not a readable recording ({str(error).splitlines()[0]}); if its process "
            "was killed, repair it with: rerun rrd optimize FILE -o REPAIRED"
        ) from None


def _texts(column: pa.Array) -> list[str]:
    """Values of a static column, as text."""
    value: Any = column[0].as_py()
    return [str(item) for item in value] if isinstance(value, list) else [str(value)]


def _order(batches: list[pa.RecordBatch]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    samples = np.concatenate([np.asarray(batch.column(SAMPLE)) for batch in batches])
    order = np.argsort(samples, kind="stable")
    return samples[order], order


def _columns(
    batches: list[pa.RecordBatch], signals: int
) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
    """Sample numbers and, for each signal of a bundle, its values (K,) or (K, N)."""
    if not batches:
        return np.empty(0, np.int64), [np.empty(0)] * signals
    samples, order = _order(batches)
    lists = [batch.column(_SCALARS) for batch in batches]
    flat = np.concatenate([column.flatten().to_numpy() for column in lists])
    values = flat.reshape(len(samples), signals, -1)[order]
    parts = [np.ascontiguousarray(values[:, i]) for i in range(signals)]
    return samples, [part[:, 0] if part.shape[1] == 1 else part for part in parts]


def _time(batches: list[pa.RecordBatch]) -> NDArray[np.float64]:
    _, order = _order(batches)
    if any(TIME not in batch.schema.names for batch in batches):
        return np.full(len(order), np.nan)
    columns = [np.asarray(batch.column(TIME).cast(pa.int64())) for batch in batches]
    return np.concatenate(columns)[order] / 1e9


def _status(batches: list[pa.RecordBatch], samples: NDArray[np.int64]) -> list[str]:
    """Every sample's status from the changes that were recorded."""
    if not batches:
        return []
    at, order = _order(batches)
    texts = [text[0] for batch in batches for text in batch.column(_STATUS).to_pylist()]
    last = np.searchsorted(at, samples, side="right") - 1
    return [texts[order[i]] for i in last]
