"""Reads a recording back: signals with every bit, units, and the run's properties."""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import RerunWarning

from cosim.core.errors import RecordingError
from cosim.core.scenario import VIOLATING

TIMELINE = "time"
SAMPLE = "sample"
STATUS_ENTITY = "/solver/status"
SIGNAL = "cosim.Signal"
"""Archetype of the static mark (name, unit) on every entity that holds a signal."""
_NAMES = f"{SIGNAL}:name"
_UNITS = f"{SIGNAL}:unit"
StaticTexts = dict[str, dict[str, list[str]]]
"""Texts that hold for a whole recording, by entity and component."""
_SCALARS = rr.Scalars.descriptor_scalars().component
_STATE_COLUMN = rr.StateChange.descriptor_state().component


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
    static, rows_of = _entities(Path(path))
    units_of = _units_by_entity(static, path)
    signals: dict[str, NDArray[np.float64]] = {}
    intermediate: dict[str, NDArray[np.float64]] = {}
    all_units: dict[str, str] = {}
    samples = np.empty(0, np.int64)
    time = np.empty(0)
    for entity, units in units_of.items():
        all_units |= units
        names = list(units)
        rows = rows_of.get(entity)
        if rows is None:
            signals |= dict.fromkeys(names, np.empty(0))
            continue
        values = _values(rows, len(names))
        moments = _time(rows)
        if entity.startswith("/intermediate/"):
            # States within a sample have rows of their own, several a sample.
            states = np.column_stack([moments, *values])
            in_time = moments.argsort(kind="stable")
            intermediate[names[0]] = states[in_time]
            continue
        signals |= dict(zip(names, values, strict=True))
        # The entity with the most rows has all samples.
        if len(rows) > len(samples):
            samples = np.asarray(rows[SAMPLE])
            time = moments
    status: list[str] = []
    # A training has no status.
    if STATUS_ENTITY in rows_of:
        status = _status(rows_of[STATUS_ENTITY], samples)
    return Recording(
        # Entities come in the order in which the file's chunks were written.
        signals=dict(sorted(signals.items())),
        samples=samples,
        time=time,
        units=all_units,
        properties=_properties(static),
        status=status,
        intermediate=intermediate,
    )


def _units_by_entity(
    static: StaticTexts,
    path: str | Path,
) -> dict[str, dict[str, str]]:
    """Units of the signals of each entity that holds any, by the signal's name.

    Args:
        static: static texts of each entity by component.
        path: of the file, for the messages.
    """
    units_of = {}
    for entity, texts in static.items():
        # The writer marks an entity of signals by their names; bounds and status are unmarked.
        if _NAMES not in texts:
            continue
        names = texts[_NAMES]
        units = texts.get(_UNITS, [])
        if len(names) != len(units):
            raise RecordingError(f"{path} was recorded by another version of rti-cosim")
        units_of[entity] = dict(zip(names, units, strict=True))
    if not units_of:
        raise RecordingError(f"{path} holds no signals of rti-cosim")
    return units_of


def _entities(path: Path) -> tuple[StaticTexts, dict[str, pa.Table]]:
    """The static texts of each entity by component, and the rows of each that has any."""
    static: StaticTexts = defaultdict(dict)
    batches: dict[str, list[pa.RecordBatch]] = defaultdict(list)
    for chunk in _chunks(path):
        batch = chunk.to_record_batch()
        columns = batch.schema.names
        entity = chunk.entity_path
        if chunk.is_static:
            for column in columns:
                static[entity][column] = _static_texts(batch.column(column))
        # Rows without a sample are not of this package.
        elif SAMPLE in columns:
            batches[entity].append(batch)
    rows_of = {entity: _stacked_rows(parts) for entity, parts in batches.items()}
    return static, rows_of


def _properties(static: StaticTexts) -> dict[str, str]:
    """The run's properties, from the static texts of each entity."""
    properties = {}
    for entity, texts in static.items():
        if not entity.endswith("/run"):
            continue
        for key, text in texts.items():
            # Rerun's own components stand among ours.
            internal = ":" in key or key == "rerun.controls.RowId"
            if text and not internal:
                properties[key] = text[0]
        break
    return properties


def worst_moment(path: str | Path) -> float | None:
    """Time in s (training: sample) of the worst violation, or of the end; None if unreadable."""
    try:
        recording = read_recording(path)
    except RecordingError:
        return None
    if not len(recording.samples):
        return None
    # A training has no time.
    timed = np.isfinite(recording.time)
    moments = np.where(timed, recording.time, recording.samples)
    violation = recording.signals.get("violation", np.zeros(1))
    # The end, unless a bound was violated.
    worst = -1
    if np.nanmax(violation, initial=0.0) > VIOLATING:
        worst = int(np.nanargmax(violation))
    return float(moments[worst])


def summarise(path: str | Path) -> dict[str, Any]:
    """Return what a recording holds, ready for JSON: properties, and each signal's unit and range.

    Raises RecordingError as `read_recording` does.
    """
    recording = read_recording(path)
    signals = {}
    for name, values in recording.signals.items():
        finite = values[np.isfinite(values)]
        lowest = None
        highest = None
        # JSON has no NaN and no infinity.
        if finite.size:
            lowest = float(finite.min())
            highest = float(finite.max())
        signals[name] = {
            "unit": recording.units[name],
            "minimum": lowest,
            "maximum": highest,
        }
    counts = Counter(recording.status)
    return {
        "properties": recording.properties,
        "samples": len(recording.samples),
        "signals": signals,
        "statuses": dict(sorted(counts.items())),
    }


def existing(path: str | Path) -> Path:
    """The path; raises RecordingError where there is no such file."""
    if not Path(path).is_file():
        raise RecordingError(f"there is no recording {path}")
    return Path(path)


def _chunks(path: Path) -> list[Chunk]:
    try:
        existing(path)
        with warnings.catch_warnings():
            # A file without its end is reported below, once.
            warnings.simplefilter("ignore", RerunWarning)
            return RrdReader(path).stream().to_chunks()
    except (ValueError, RuntimeError, OSError) as error:
        # Rerun's message may have several lines; an error of ours has one.
        reason = str(error).splitlines()[0]
        raise RecordingError(
            f"{path} is not a readable recording ({reason}); if its process was killed, repair it "
            "with: rerun rrd optimize FILE -o REPAIRED"
        ) from None


def _static_texts(column: pa.Array) -> list[str]:
    """Values of a static column, as text."""
    # A static column has one row: a value, or a list of them.
    value: Any = column[0].as_py()
    values = value if isinstance(value, list) else [value]
    return [str(item) for item in values]


def _stacked_rows(batches: list[pa.RecordBatch]) -> pa.Table:
    """Rows of an entity, by sample."""
    table = pa.Table.from_batches(batches)
    samples = np.asarray(table[SAMPLE])
    # Stable, since a sample may have several rows (`intermediate`), in the order of time.
    in_order = np.argsort(samples, kind="stable")
    return table.take(in_order)


def _values(rows: pa.Table, n_signals: int) -> list[NDArray[np.float64]]:
    """Values of each signal of an entity, (K,) or (K, N)."""
    scalars = pc.list_flatten(rows[_SCALARS])
    flat = scalars.to_numpy()
    # A row has the numbers of the first signal, then those of the next.
    table = flat.reshape(len(rows), n_signals, -1)
    signals = []
    for index in range(n_signals):
        values = np.ascontiguousarray(table[:, index])
        # One number a row is a signal; several are a prediction, or a block of θ.
        if values.shape[1] == 1:
            values = values[:, 0]
        signals.append(values)
    return signals


def _time(rows: pa.Table) -> NDArray[np.float64]:
    """Time of the rows in s, (K,), NaN of a training, which has none."""
    if TIMELINE not in rows.schema.names:
        return np.full(len(rows), np.nan)
    nanoseconds = rows[TIMELINE].cast(pa.int64())
    return np.asarray(nanoseconds) / 1e9


def _status(changes: pa.Table, samples: NDArray[np.int64]) -> list[str]:
    """Every sample's status from the changes that were recorded."""
    lists = changes[_STATE_COLUMN].to_pylist()
    words = [states[0] for states in lists]
    changed_at = np.asarray(changes[SAMPLE])
    # The last change at or before each sample.
    following = np.searchsorted(changed_at, samples, side="right")
    return [words[change] for change in following - 1]
