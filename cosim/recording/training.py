"""Records a training: its log and θ over the plant samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun.blueprint as rrb

from cosim.protocols import Array
from cosim.recording.stream import (
    SAMPLE,
    SERIES,
    Channel,
    Stream,
    about_view,
    axis,
    escaped,
    layout,
    table,
    times,
    view,
)


def record_training(
    path: str | Path,
    title: str,
    log: Mapping[str, Array],
    increments: Mapping[str, Array],
    labels: Mapping[str, Sequence[str]],
    properties: Mapping[str, object],
) -> None:
    """Write a recording of a training: the signals are the log's columns and `increment/<block>`.

    `log` holds columns (K,), among them `samples`, NaN where not measured; `increments` the change
    of each block of θ since the start, (K, size), and `labels` the names of its entries.

    Raises
    ------
    RecordingError : the file cannot be written.
    """
    samples = log["samples"]
    blocks = {
        name: Channel(
            f"increment/{escaped(name)}", f"increment/{name}", labels=list(labels[name])
        ).see(values)
        for name, values in increments.items()
    }
    columns = {
        name: Channel(
            f"log/{escaped(name)}",
            name,
            color=SERIES[number % len(SERIES)],
            points=bool(np.isnan(values).any()),
        ).see(values)
        for number, (name, values) in enumerate(log.items())
    }
    along = axis(samples=int(samples[-1]) if len(samples) else 0)
    views = layout(
        rrb.Tabs(
            rrb.Grid(*(view(f"change of {n}", [b], along) for n, b in blocks.items()), name="θ"),
            rrb.Grid(*(view(name, [c], along) for name, c in columns.items()), name="log"),
            about_view("about this training"),
        ),
        SAMPLE,
    )
    with Stream(path, title, views) as stream:
        stream.properties(properties)
        stream.about(f"# {title}\n\n{table('training', properties)}\n")
        rows = times(samples.astype(np.int64))
        for name, block in blocks.items():
            stream.send([block], rows, increments[name])
        for name, column in columns.items():
            stream.send([column], rows, log[name])
