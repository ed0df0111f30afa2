"""A study's tables as pandas frames, read and written without the loss of a bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cosim.errors import StudyError
from cosim.text_tables import read_csv

Table = tuple[str, Sequence[str], list[list[str]]]
"""Title, header and rows of texts."""
WHERE = ["scenario", "case"]
KEYS = [*WHERE, "training_seed"]
STATE = [*KEYS, "status", "samples", "plant_samples"]
CURVE = ["samples", "J", "greedy_J", "td_error"]
TYPES: dict[str, Any] = {"scenario": str, "case": str, "training_seed": "Int64", "status": str}
"""Types of columns by name; all others are floats, NaN where a cell is empty."""


def read_table(
    path: Path, columns: Sequence[str] = (), types: Mapping[str, Any] | None = None
) -> pd.DataFrame:
    """Columns of a CSV, all if none is named, with those of `types`, which go beside `TYPES`.

    Raises StudyError.
    """
    header, *rows = read_csv(path, StudyError)
    kinds = TYPES | dict(types or {})
    frame = pd.DataFrame()
    try:
        for name in dict.fromkeys([*(columns or header), *(types or ())]):
            texts = [row[header.index(name)] for row in rows]
            frame[name] = _converted(texts, kinds.get(name, float))
        if any(len(row) != len(header) for row in rows):
            raise ValueError("a row is torn")
    except (IndexError, ValueError) as error:
        raise StudyError(f"'{path}' is damaged: {error}") from None
    return frame


def _converted(texts: Sequence[str], kind: Any) -> Any:
    if kind == "Int64":
        return pd.array([int(text) if text else pd.NA for text in texts], dtype="Int64")
    if kind is float:
        return np.array([float(text or "nan") for text in texts], dtype=np.float64)
    return pd.Series(texts, dtype=str) if kind is str else np.array([int(text) for text in texts])


def to_csv(frame: pd.DataFrame) -> str:
    """A frame as CSV; floats read back to the same bits, what is undefined is empty."""
    return str(frame.to_csv(index=False, lineterminator="\n"))
