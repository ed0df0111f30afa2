"""Records what has ended: runs over each other, and A − B of two; a training, by its samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from math import inf
from pathlib import Path

import numpy as np
import rerun.blueprint as rrb

from cosim.comparison import RunSignals
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


def record_overlay(path: str | Path, runs: Mapping[str, RunSignals], about: str) -> None:
    """Write a recording of runs of one scenario by name, over each other; raises RecordingError.

    The signals are `<run>/<signal>` for every signal that all runs have, and, of two runs,
    `difference/<signal>`; bounds are those that the first run knows. `about` is Markdown.
    """
    first, *others = runs.values()
    common = [n for n in first.signals if n != "time" and all(n in run.signals for run in others)]
    overlaid = {
        signal: [
            Channel(
                f"{escaped(name)}/{escaped(signal)}",
                f"{name}/{signal}",
                run.signals[signal].unit,
                color,
                first.bounds.get(signal, (-inf, inf)) if run is first else (-inf, inf),
                labels=[name],
            ).see(run.signals[signal].values)
            for (name, run), color in zip(runs.items(), cycle(SERIES), strict=False)
        ]
        for signal in common
    }
    differences = {s: _difference(s, first, others[0]) for s in common if len(runs) == 2}
    seconds = max((float(_time(run)[-1]) for run in runs.values() if len(run)), default=0.0)
    along = axis(seconds=seconds)
    plots = [
        view(replace(channels[0], name=signal).title, channels, along)
        for signal, channels in overlaid.items()
    ]
    deviations = [view(c.title, [c], along) for c, _ in differences.values()]
    tabs = [rrb.Grid(*plots, grid_columns=3, name=" / ".join(runs))]
    if deviations:
        tabs.append(rrb.Grid(*deviations, grid_columns=3, name="difference"))
    views = layout(rrb.Tabs(*tabs, about_view("about")))
    with Stream(path, " / ".join(runs), views) as stream:
        stream.about(about)
        ends = times([0, max(map(len, runs.values())) - 1], np.array([0.0, seconds]))
        for signal, channels in overlaid.items():
            stream.bounds(channels, ends)
            for channel, run in zip(channels, runs.values(), strict=True):
                rows = times(np.arange(len(run)), _time(run))
                stream.send([channel], rows, run.signals[signal].values)
        for channel, values in differences.values():
            rows = times(np.arange(len(values)), _time(first)[: len(values)])
            stream.send([channel], rows, values)


def _difference(signal: str, a: RunSignals, b: RunSignals) -> tuple[Channel, Array]:
    x, y = a.signals[signal].values, b.signals[signal].values
    length = min(len(x), len(y))
    with np.errstate(invalid="ignore"):
        values = x[:length] - y[:length]
    name, unit = f"difference/{signal}", a.signals[signal].unit
    return Channel(f"difference/{escaped(signal)}", name, unit, SERIES[3]).see(values), values


def _time(run: RunSignals) -> Array:
    return run.signals["time"].values if "time" in run.signals else np.arange(float(len(run)))


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

    Raises RecordingError where the file cannot be written.
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
