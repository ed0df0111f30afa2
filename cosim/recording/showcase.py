"""Records what learning changed: several controllers on the same disturbances, and the training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import cycle
from math import inf
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cosim.recording.blueprint import framed, sample_axis, series, union
from cosim.recording.channels import Channel, escaped
from cosim.recording.glyphs import drawable
from cosim.recording.palette import BOUND, SERIES
from cosim.recording.stream import SAMPLE, Stream, line, lines, mark
from cosim.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingHistory:
    """A training as curves over its samples: `samples` (K,), and by title what is drawn.

    `curves` are values (K,), `theta` the change of each block of θ, (K, size of the block), with
    `labels` for the entries.
    """

    samples: Array
    curves: Mapping[str, Array]
    theta: Mapping[str, Array]
    labels: Mapping[str, tuple[str, ...]]


def record_showcase(
    path: str | Path, runs: Mapping[str, Trajectory], history: TrainingHistory, about: str
) -> None:
    """Write a recording with runs of one scenario over each other beside a training.

    Entities are `<signal>/<controller>`, `training/<curve>` and `theta/<block>`, all over sample
    numbers; `about` is Markdown. Raises RecordingError.
    """
    first = next(iter(runs.values()))
    scenario, plant = first.scenario, first.scenario.plant
    stream = Stream(path, f"before and after learning on {scenario.name}")
    stream.static("about", rr.TextDocument(drawable(about), media_type=rr.MediaType.MARKDOWN))
    bounds = scenario.limits
    names = [*bounds, "penalty"]
    steps = max(len(run.time) for run in runs.values())
    overlaid = {}
    for name in names:
        unit, between = first.signals[name].unit, bounds.get(name, (-inf, inf))
        overlaid[name] = [
            Channel(name, controller, unit, color, between).with_values(run[name])
            for (controller, run), color in zip(runs.items(), cycle(SERIES), strict=False)
        ]
    curves = {
        title: Channel("training", title, "", color).with_values(values)
        for (title, values), color in zip(history.curves.items(), cycle(SERIES), strict=False)
    }
    blocks = {
        name: Channel("theta", name, "", SERIES[0]).with_values(values)
        for name, values in history.theta.items()
    }
    every = [*(c for group in overlaid.values() for c in group), *curves.values(), *blocks.values()]
    labels = {name: replace(c[0], name=name).title for name, c in overlaid.items()}
    stream.layout(_blueprint(labels, overlaid, curves, blocks, steps, history), every)
    for name, channels in overlaid.items():
        step = name in plant.actions
        for channel, run in zip(channels, runs.values(), strict=True):
            signal = mark([f"{channel.name}: {name}"], [channel.unit])
            stream.static(channel.entity, signal, line(channel.name, channel.color, step=step))
            times = [rr.TimeColumn(SAMPLE, sequence=np.arange(len(run.time)))]
            stream.scalars(channel.entity, times, run[name])
        for kind, bound in zip(("lower", "upper"), bounds.get(name, ()), strict=False):
            entity = f"{name}/{kind} bound"
            stream.static(escaped_path(entity), line(f"{kind} bound", BOUND, width=1.0))
            ends = [rr.TimeColumn(SAMPLE, sequence=[0, steps])]
            stream.scalars(escaped_path(entity), ends, np.array([bound, bound]))
    times = [rr.TimeColumn(SAMPLE, sequence=history.samples.astype(np.int64))]
    for title, channel in curves.items():
        stream.static(channel.entity, mark([title], [""]), line(title, channel.color))
        stream.scalars(channel.entity, times, history.curves[title])
    for name, channel in blocks.items():
        entries = history.labels[name]
        colors = [color for _, color in zip(entries, cycle(SERIES), strict=False)]
        signal = mark(entries, [""] * len(entries))
        stream.static(channel.entity, signal, lines(entries, colors))
        stream.scalars(channel.entity, times, history.theta[name])
    stream.close()


def escaped_path(path: str) -> str:
    """A path of two parts, each of which may be any text."""
    return "/".join(escaped(part) for part in path.split("/"))


def _blueprint(
    labels: Mapping[str, str],
    overlaid: Mapping[str, list[Channel]],
    curves: Mapping[str, Channel],
    blocks: Mapping[str, Channel],
    steps: int,
    history: TrainingHistory,
) -> rrb.Blueprint:
    axis, trained = sample_axis(steps), sample_axis(int(history.samples[-1]))
    loop = [
        series(
            labels[name],
            [f"/{channels[0].entity.rpartition('/')[0]}/**"],
            axis,
            union(channels),
            legend=number == 0,
        )
        for number, (name, channels) in enumerate(overlaid.items())
    ]
    training = [
        series(f"training: {title}", [f"/{channel.entity}"], trained, channel.window())
        for title, channel in curves.items()
    ]
    theta = [
        series(
            f"training: change of {name}", [f"/{c.entity}"], trained, c.window(), legend=c_legend
        )
        for name, c in blocks.items()
        for c_legend in (len(history.labels[name]) <= 4,)
    ]
    about = rrb.TextDocumentView(name="what this is", origin="/about")
    return framed(
        rrb.Horizontal(
            rrb.Vertical(*loop),
            rrb.Vertical(about, *training),
            rrb.Grid(*theta, grid_columns=2),
            column_shares=[4, 3, 4],
        ),
        SAMPLE,
    )
