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

_TOGETHER = {
    "cost per sample": ("J", "greedy_J"),
    "TD error": ("td_error",),
    "regret": ("regret",),
    "smallest eigenvalue": ("smallest_eigenvalue",),
}


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
    last = int(samples[-1]) if len(samples) else 0
    with Stream(path, title, _layout(blocks, columns, last)) as stream:
        stream.properties(properties)
        stream.about(f"# {title}\n\n{table('training', properties)}\n")
        rows = times(samples.astype(np.int64))
        for name, block in blocks.items():
            stream.send([block], rows, increments[name])
        for name, column in columns.items():
            stream.send([column], rows, log[name])


def _layout(
    blocks: Mapping[str, Channel], columns: Mapping[str, Channel], samples: int
) -> rrb.Blueprint:
    along = axis(samples=samples)
    theta = [
        view(f"change of {name}", [block], along, legend=len(block.labels) in (2, 3, 4))
        for name, block in blocks.items()
    ]
    grouped = {
        title: [columns[name] for name in names if name in columns]
        for title, names in _TOGETHER.items()
    }
    shown = {channel.name for group in grouped.values() for channel in group}
    figures = [view(title, group, along) for title, group in grouped.items() if group]
    rest = [view(name, [column], along) for name, column in columns.items() if name not in shown]
    more = rrb.Tabs(about_view("about this training"), rrb.Grid(*rest, name="the rest of the log"))
    return layout(
        rrb.Horizontal(
            rrb.Grid(*theta, grid_columns=2),
            rrb.Vertical(*figures),
            more,
            column_shares=[3, 3, 2],
        ),
        SAMPLE,
    )
