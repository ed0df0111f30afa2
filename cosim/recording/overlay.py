"""Records two runs over each other: the same plots, prefixed entities, and their difference."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cosim.comparison import Comparison, RunSignals
from cosim.recording.blueprint import framed, series, time_axis, union
from cosim.recording.channels import Channel, escaped
from cosim.recording.glyphs import drawable
from cosim.recording.palette import BOUND, SERIES
from cosim.recording.stream import Stream, line, sample_times

_SIDES = ("A", "B")


def record_comparison(
    path: str | Path, a: RunSignals, b: RunSignals, comparison: Comparison
) -> None:
    """Write a recording with runs A and B overlaid, and A − B; raises RecordingError.

    Entities are `A/<signal>`, `B/<signal>` and `difference/<signal>`; the lines have the runs'
    names, and a signal's bounds are drawn where a run says what they are.
    """
    names = [d.name for d in comparison.differences if d.name != "time"]
    overlaid = {name: _channels(name, (a, b)) for name in names}
    differences = {name: _difference(name, a, b) for name in names}
    duration = max(float(_time(run)[-1]) if len(run) else 0.0 for run in (a, b))
    stream = Stream(path, "comparison")
    title = drawable(f"A: {a.name}, B: {b.name}")
    stream.layout(_blueprint(title, duration, overlaid, differences), [])
    text = _text(a, b, comparison)
    stream.static("about", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
    for run, side in zip((a, b), _SIDES, strict=True):
        times = sample_times(np.arange(len(run)), _time(run))
        for name in names:
            channel = overlaid[name][_SIDES.index(side)]
            stream.static(channel.entity, line(f"{side}: {run.label}", channel.color))
            stream.scalars(channel.entity, times, run.signals[name].values)
    ends = sample_times(np.array([0, max(len(a), len(b)) - 1]), np.array([0.0, duration]))
    for name, channels in overlaid.items():
        for side, bound in zip(("lower", "upper"), channels[0].bounds, strict=True):
            if isfinite(bound):
                entity = f"bounds/{escaped(name)}/{side}"
                stream.static(entity, line(f"{side} bound", BOUND))
                stream.scalars(entity, ends, np.full(2, bound))
    common = min(len(a), len(b))
    times = sample_times(np.arange(common), _time(a)[:common])
    for channel, values in differences.values():
        stream.static(channel.entity, line("A - B", channel.color))
        stream.scalars(channel.entity, times, values)
    stream.close()


def _channels(name: str, runs: tuple[RunSignals, RunSignals]) -> list[Channel]:
    bounds = runs[0].bounds.get(name, (-inf, inf))
    return [
        Channel(side, name, run.signals[name].unit, color, bounds).with_values(
            run.signals[name].values
        )
        for side, run, color in zip(_SIDES, runs, SERIES, strict=False)
    ]


def _difference(name: str, a: RunSignals, b: RunSignals) -> tuple[Channel, np.ndarray]:
    common = min(len(a), len(b))
    with np.errstate(invalid="ignore"):
        values = a.signals[name].values[:common] - b.signals[name].values[:common]
    channel = Channel("difference", name, a.signals[name].unit, SERIES[3]).with_values(values)
    return channel, values


def _time(run: RunSignals) -> np.ndarray:
    return run.signals["time"].values if "time" in run.signals else np.arange(float(len(run)))


def _blueprint(
    title: str,
    duration: float,
    overlaid: dict[str, list[Channel]],
    differences: dict[str, tuple[Channel, np.ndarray]],
) -> rrb.Blueprint:
    axis = time_axis(duration)
    runs = [
        series(
            channels[0].title,
            [*(f"/{channel.entity}" for channel in channels), f"/bounds/{escaped(name)}/**"],
            axis,
            union(channels),
            legend=True,
        )
        for name, channels in overlaid.items()
    ]
    deviations = [
        series(f"A - B: {channel.label}", [f"/{channel.entity}"], axis, channel.window())
        for channel, _ in differences.values()
    ]
    return framed(
        rrb.Tabs(
            rrb.Grid(*runs, grid_columns=3, name=title),
            rrb.Grid(*deviations, grid_columns=3, name="A - B"),
            rrb.TextDocumentView(name="what differs", origin="/about"),
        )
    )


def _text(a: RunSignals, b: RunSignals, comparison: Comparison) -> str:
    found = comparison.lines() or ["no signal differs by more than its tolerance"]
    rows = "\n".join(
        f"| {d.name} | {d.unit or '-'} | {_number(d.maximum)} | {d.at} | {d.tolerance:.6g} |"
        for d in comparison.differences
    )
    page = f"""# A against B

A: {a.name}

B: {b.name}

{_bullets(found)}

| signal | unit | largest difference | at sample | tolerance |
|---|---|---|---|---|
{rows}
"""
    return drawable(page)


def _bullets(lines: Sequence[str]) -> str:
    return "\n".join(f"- {text}" for text in lines)


def _number(value: float) -> str:
    return f"{value:.6g}" if isfinite(value) else "NaN in one run only"
