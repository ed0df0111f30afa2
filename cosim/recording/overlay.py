"""Records ended runs of one scenario over each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
from rerun import escape_entity_path_part as escaped

from cosim.core.protocols import Array
from cosim.core.trajectory import RunSignals
from cosim.recording.layout import AT, OPENING, axis, tabs, view
from cosim.recording.stream import FREE, SERIES, Channel, Stream, times


def record_overlay(
    path: str | Path,
    runs: Mapping[str, RunSignals],
    about: str,
) -> None:
    """Write a recording of runs of one scenario over each other.

    The signals are `<run>/<signal>` for every signal that all runs have, and, of two runs,
    `difference/<signal>`. Bounds are those that the first run knows.

    Args:
        path: of the file.
        runs: signals of each run, by its name.
        about: Markdown of the view `/about`.

    Raises:
        OSError: if the file cannot be begun.
        RecordingError: if it is not written whole.
    """
    first, *others = runs.values()
    # Runs may be of unlike lengths: bounds and axis reach to the end of the longest.
    seconds = 0.0
    last = -1
    for run in runs.values():
        time = _time_of(run)
        if len(time):
            seconds = max(seconds, float(time[-1]))
        last = max(last, len(run) - 1)
    along = axis(AT(seconds=0.0), AT(seconds=seconds))
    ends = times([0, last], np.array([0.0, seconds]))
    title = " / ".join(runs)
    overlaid = []
    differences = []
    common = _common_signals(runs)
    opening = _opening_signals(common, first)
    with Stream(path, title, about) as stream:
        for signal in common:
            lines = _overlaid_lines(runs, signal)
            for line, run in zip(lines, runs.values(), strict=True):
                values = run.signals[signal].values
                rows = _sample_times(_time_of(run))
                stream.send([line], rows, values, ends)
            # The title has the unit and the bounds, but no run's name.
            titled = replace(lines[0], name=signal)
            # One legend names the runs: more of them would cover the lines.
            plot = view(titled.title, lines, along, legend=signal == opening[0])
            overlaid.append((signal, plot))
            # A difference of more than two runs would need one to compare with.
            if len(runs) == 2:
                line = _send_difference(stream, first, others[0], signal)
                plot = view(line.title, [line], along)
                differences.append(plot)
        views_of = {
            title: [plot for signal, plot in overlaid if signal in opening],
            "all signals": [plot for signal, plot in overlaid if signal not in opening],
            "difference": differences,
        }
        stream.layout = tabs(views_of)


def _opening_signals(names: Sequence[str], run: RunSignals) -> list[str]:
    """The signals that the recording opens on: those with bounds in a run, else the first ones."""
    bounded = [name for name in names if name in run.bounds]
    others = [name for name in names if name not in run.bounds]
    return [*bounded, *others][:OPENING]


def _common_signals(runs: Mapping[str, RunSignals]) -> list[str]:
    """Names of the signals that all runs have, in the order of the first run."""
    first, *others = runs.values()
    common = []
    for signal in first.signals:
        # Time is the axis of all others.
        if signal != "time" and all(signal in run.signals for run in others):
            common.append(signal)
    return common


def _send_difference(
    stream: Stream,
    one: RunSignals,
    other: RunSignals,
    signal: str,
) -> Channel:
    """Send a signal of one run less that of the other, and return how it is drawn."""
    line = Channel(
        entity=f"difference/{escaped(signal)}",
        name=f"difference/{signal}",
        unit=one.signals[signal].unit,
        color=SERIES[3],
    )
    minuend = one.signals[signal].values
    subtrahend = other.signals[signal].values
    values = _signal_difference(minuend, subtrahend)
    time = _time_of(one)[: len(values)]
    stream.send([line], _sample_times(time), values)
    return line


def _sample_times(time: Array) -> list[rr.TimeColumn]:
    """Index columns of the samples from the first on, at K times [s]."""
    samples = np.arange(len(time))
    return times(samples, time)


def _time_of(run: RunSignals) -> Array:
    """Time of a run's samples in s, (K,); their numbers where it is not known."""
    if "time" in run.signals:
        return run.signals["time"].values
    return np.arange(float(len(run)))


def _overlaid_lines(runs: Mapping[str, RunSignals], signal: str) -> list[Channel]:
    """A signal's line in each run, in the run's colour."""
    from cosim.figures.style import lighten, palette  # noqa: PLC0415 - matplotlib: 0.3 s

    styles = palette(list(runs))
    lines: list[Channel] = []
    for name, run in runs.items():
        bounds = FREE
        # The bounds of the others would lie on those of the first.
        if not lines:
            bounds = run.bounds.get(signal, FREE)
        line = Channel(
            entity=f"{escaped(name)}/{escaped(signal)}",
            name=f"{name}/{signal}",
            unit=run.signals[signal].unit,
            color=lighten(styles[name].color),
            bounds=bounds,
            labels=[name],
        )
        lines.append(line)
    return lines


def _signal_difference(one: Array, other: Array) -> Array:
    """One signal less the other, (K,), over the K samples that both have."""
    common = min(len(one), len(other))
    # Two infinite values have no difference: NaN draws a gap.
    with np.errstate(invalid="ignore"):
        difference: Array = one[:common] - other[:common]
    return difference
