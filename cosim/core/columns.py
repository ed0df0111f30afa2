"""Long runs as Parquet files: column by column, where text takes as long as the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.errors import TrajectoryError
from cosim.core.files import replacing
from cosim.core.protocols import Array


def write_columns(
    path: str | Path,
    columns: Mapping[str, Array],
    words: Mapping[str, Sequence[str]],
) -> Path:
    """Write a table as a Parquet file, whole or not at all.

    Args:
        path: of the file.
        columns: numbers by title, (K,) each; an array of integers stays one.
        words: texts by title, K each, behind the numbers.

    Returns:
        The path.

    Raises:
        OSError: it cannot be written.
    """
    import pyarrow as pa  # noqa: PLC0415 - a tenth of a second
    from pyarrow import parquet  # noqa: PLC0415

    arrays: dict[str, Any] = {title: pa.array(values) for title, values in columns.items()}
    for title, texts in words.items():
        arrays[title] = pa.array(texts, pa.string())
    with replacing(path) as partial:
        # Numbers of a closed loop hardly repeat; words do.
        parquet.write_table(pa.table(arrays), partial, use_dictionary=list(words))
    return Path(path)


def read_columns(
    path: str | Path, words: Sequence[str]
) -> tuple[dict[str, Array], list[list[str]]]:
    """Read what `write_columns` wrote.

    Args:
        path: of the file.
        words: titles of the texts.

    Returns:
        The numbers by title, (K,) each, as floats; and the texts of each of `words`.

    Raises:
        TrajectoryError: it is no such file, or has no such column.
    """
    import pyarrow as pa  # noqa: PLC0415
    from pyarrow import parquet  # noqa: PLC0415

    try:
        table = parquet.read_table(path)
        texts = [table[title].to_pylist() for title in words]
        numbers = {}
        for title in table.column_names:
            if title not in words:
                numbers[title] = table[title].to_numpy().astype(np.float64)
    except (OSError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise TrajectoryError(f"'{path}' cannot be read: {reason}") from None
    return numbers, texts
