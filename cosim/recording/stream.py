"""A Rerun file: signals in blocks of columns, the views' layout, a name only when it is whole."""

from __future__ import annotations

import atexit
import os
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import NoReturn, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cosim.errors import RecordingError
from cosim.files import check_target, publish
from cosim.protocols import Array

TIME, SAMPLE = "time", "sample"
SIGNAL = "cosim.Signal"
"""Archetype of the static mark (name, unit) on every entity that holds a signal."""

SERIES = ("#3B94DE", "#E8731F", "#22AC7E", "#CC79A7", "#E5A11A", "#6CC3F0")
BOUND = "#D8392B"
_DRAWABLE = ((0x20, 0x24F), (0x370, 0x4FF), (0x2010, 0x2026))
_FOOTER = b"RRF2FOOT"
_WRITE_SECONDS = 30.0
_ABANDONED: list[rr.RecordingStream] = []

Range = tuple[float, float]


@dataclass
class Channel:
    """A signal in a recording: its entity, how it is drawn, and the range `seen` of its values.

    `labels` name the lines of a signal with several numbers a row. `step` holds a value until the
    next one, `points` draws dots, for values between NaN; `bounds` may be infinite.
    """

    entity: str
    name: str
    unit: str = ""
    color: str = SERIES[0]
    bounds: Range = (-inf, inf)
    labels: Sequence[str] = ()
    step: bool = False
    points: bool = False
    seen: Range = (inf, -inf)

    @property
    def title(self) -> str:
        """Name, unit and bounds in words: the viewer's lines have no labels, its font no ≥."""
        label = self.name if self.unit in ("", "1") else f"{self.name} [{self.unit}]"
        sides = zip(("at least", "at most"), self.bounds, strict=True)
        return ", ".join([label, *(f"{side} {b:g}" for side, b in sides if isfinite(b))])

    def see(self, values: Array, *, tail: float = 0.0) -> Self:
        """Widen the range seen by values of any shape, without the share `tail` of the largest."""
        values = values[np.isfinite(values)]
        if values.size:
            low, high = self.seen
            top = np.quantile(values, 1.0 - tail) if tail else values.max()
            self.seen = (min(low, float(values.min())), max(high, float(top)))
        return self

    def window(self) -> Range | None:
        """Range of view: the values seen and each bound within their span; None before any."""
        low, high = self.seen
        if low > high:
            return None
        lower, upper = self.bounds
        span = max(high - low, 1e-3 * max(abs(low), abs(high))) or 1.0
        low = min(low, lower) if low - span <= lower else low
        high = max(high, upper) if upper <= high + span else high
        margin = 0.06 * max(high - low, span)
        return low - margin, high + margin


class Stream:
    """An open recording: `static` and `send`, then `close`; an exception in its block discards it.

    The layout stands first in the file, as Rerun wants it, and `close` can send a better one. The
    file is written beside `path` under a hidden name and renamed by `close`, so that `path` never
    holds half a recording; `rerun rrd optimize` repairs what a killed process leaves.

    Raises RecordingError where the folder does not exist or cannot be written.
    """

    def __init__(self, path: str | Path, name: str, layout: rrb.Blueprint) -> None:
        self.path = check_target(path)
        name_of_partial = f".{self.path.stem}.{secrets.token_hex(4)}.partial.rrd"
        self._partial = self.path.with_name(name_of_partial)
        try:
            self._partial.touch()
        except OSError as error:
            raise RecordingError(
                f"cannot write the recording {self.path}: {error.strerror}"
            ) from None
        # Without it a column of the wrong shape is dropped with no more than a warning.
        rr.set_strict_mode(True)
        self._stream = rr.RecordingStream("rti-cosim")
        self._stream.send_recording_name(drawable(name))
        self._declared: set[str] = set()
        self._bounded(partial(self._stream.save, self._partial, default_blueprint=layout))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def properties(self, values: Mapping[str, object]) -> None:
        """Describe the run as a whole; shown in the viewer when the recording is selected."""
        described = rr.AnyValues()
        for key, value in values.items():
            described.with_component_from_data(key, drawable(str(value)))
        self._stream.send_property("run", described)

    def about(self, markdown: str) -> None:
        """Give the text of the view `about`."""
        page = rr.TextDocument(drawable(markdown), media_type=rr.MediaType.MARKDOWN)
        self.static("about", page)

    def static(self, entity: str, *archetypes: rr.AsComponents) -> None:
        """Log what does not change over time."""
        self._stream.log(entity, *archetypes, static=True)

    def columns(
        self, entity: str, times: list[rr.TimeColumn], columns: rr.ComponentColumnList
    ) -> None:
        """Send a block of rows."""
        self._stream.send_columns(entity, times, columns)

    def send(self, channels: Sequence[Channel], times: list[rr.TimeColumn], values: Array) -> None:
        """Send K rows of the signals of one entity: (K,), (K, m), or (K, labels)."""
        entity = channels[0].entity
        if entity not in self._declared:
            self._declared.add(entity)
            names, units = [c.name for c in channels], [c.unit for c in channels]
            mark = rr.DynamicArchetype(SIGNAL, components={"name": names, "unit": units})
            self.static(entity, mark, _style(channels))
        self.columns(entity, times, rr.Scalars.columns(scalars=np.array(values)))

    def bounds(self, channels: Sequence[Channel], ends: list[rr.TimeColumn]) -> None:
        """Draw the finite bounds of signals between two times."""
        for channel in channels:
            for side, bound in zip(("lower", "upper"), channel.bounds, strict=True):
                if isfinite(bound):
                    entity = f"bounds/{channel.entity}/{side}"
                    line = Channel(entity, f"{side} bound", color=BOUND)
                    self.static(entity, _style([line]))
                    self.columns(entity, ends, rr.Scalars.columns(scalars=[bound, bound]))

    def close(self, layout: rrb.Blueprint | None = None) -> None:
        """Finish the file, with a layout in place of the first, and give it its name.

        Raises RecordingError where not all of it could be written.
        """
        if self._stream in _ABANDONED:
            return
        if layout is not None:
            self._stream.send_blueprint(layout)
        self._bounded(self._stream.disconnect)
        with self._partial.open("rb") as written:
            written.seek(-min(len(_FOOTER) + 32, self._partial.stat().st_size), os.SEEK_END)
            if _FOOTER not in written.read():
                self._give_up("its end is missing")
        publish(self._partial, self.path)

    def discard(self) -> None:
        """End the recording without a file."""
        if self._stream not in _ABANDONED:
            self._bounded(self._stream.disconnect)
            self._partial.unlink(missing_ok=True)

    def _bounded(self, call: Callable[[], None]) -> None:
        """Let Rerun write for a limited time: once its writer has ended, it waits for ever."""
        writing = threading.Thread(target=call, daemon=True)
        writing.start()
        writing.join(_WRITE_SECONDS)
        if writing.is_alive():
            # To drop the stream, or to let Rerun shut down, would wait for ever too.
            _ABANDONED.append(self._stream)
            atexit.unregister(rr.rerun_shutdown)
            self._give_up("its writer does not answer")

    def _give_up(self, reason: str) -> NoReturn:
        raise RecordingError(
            f"the recording {self.path} could not be written ({reason}): is the disk full? Repair "
            f"what was written by: rerun rrd optimize {self._partial} -o REPAIRED.rrd"
        ) from None


def _style(channels: Sequence[Channel]) -> rr.SeriesLines | rr.SeriesPoints:
    first = channels[0]
    labels = first.labels or [channel.title.partition(",")[0] for channel in channels]
    colors = [c.color for c in channels]
    if len(labels) > len(colors):
        colors = [SERIES[i % len(SERIES)] for i in range(len(labels))]
    names = [drawable(label) for label in labels]
    # An array, since Rerun misreads a list of three numbers as one colour.
    packed = np.array([packed_color(color) for color in colors], dtype=np.uint32)
    if first.points:
        return rr.SeriesPoints(names=names, colors=packed, marker_sizes=np.full(len(names), 4.0))
    mode, policy = rr.components.InterpolationMode, rr.components.AggregationPolicy
    return rr.SeriesLines(
        names=names,
        colors=packed,
        widths=np.full(len(names), 1.5),
        # The default average would hide the violations of a run that is wider than the screen.
        aggregation_policy=policy.MinMax,
        interpolation_mode=mode.StepAfter if first.step else mode.Linear,
    )


def packed_color(color: str) -> int:
    """`#RRGGBB` as the opaque 32-bit number that Rerun takes."""
    return int(color.removeprefix("#") + "FF", 16)


def drawable(text: str) -> str:
    """Replace by `?` each character that the viewer's font lacks; the headless viewer aborts on it.

    Names and units are the user's to choose.
    """
    return "".join(
        c if c == "\n" or any(low <= ord(c) <= high for low, high in _DRAWABLE) else "?"
        for c in text
    )


def escaped(name: str) -> str:
    """A variable's name, e.g. `tank[1].level`, as one part of an entity path."""
    return rr.escape_entity_path_part(name)


def times(samples: Sequence[int] | np.ndarray, time: Array | None = None) -> list[rr.TimeColumn]:
    """Index columns of K rows: sample numbers and, where there is one, the time in s to 1 ns."""
    columns = [rr.TimeColumn(SAMPLE, sequence=np.asarray(samples, dtype=np.int64))]
    if time is not None:
        nanoseconds = np.rint(time * 1e9).astype("timedelta64[ns]")
        columns.append(rr.TimeColumn(TIME, duration=nanoseconds))
    return columns


def axis(*, seconds: float | None = None, samples: int = 0) -> rrb.TimeAxis:
    """Horizontal axis over a whole run of that length."""
    at = rr.TimeRangeBoundary.absolute
    start, end = (
        (at(seq=0), at(seq=samples)) if seconds is None else (at(seconds=0.0), at(seconds=seconds))
    )
    return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))


def view(
    title: str, channels: Sequence[Channel], along: rrb.TimeAxis, *, legend: bool | None = None
) -> rrb.TimeSeriesView:
    """A plot of signals and their bounds, in the range of view of all of them."""
    windows = [window for channel in channels if (window := channel.window())]
    shown = (min(low for low, _ in windows), max(high for _, high in windows)) if windows else None
    entities = dict.fromkeys(channel.entity for channel in channels)
    return rrb.TimeSeriesView(
        name=drawable(title),
        origin="/",
        contents=[path for e in entities for path in (f"/{e}", f"/bounds/{e}/**")],
        axis_x=along,
        axis_y=rrb.ScalarAxis(range=shown) if shown else None,
        plot_legend=rrb.PlotLegend(
            corner=rrb.Corner2D.RightTop, visible=len(channels) > 1 if legend is None else legend
        ),
    )


def about_view(name: str) -> rrb.TextDocumentView:
    """The view of the text that `Stream.about` gives."""
    return rrb.TextDocumentView(name=name, origin="/about")


def layout(root: rrb.Container, timeline: str = TIME) -> rrb.Blueprint:
    """The views with a paused time panel on a timeline, and no other panels in the way."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused"),
    )


def table(title: str, values: Mapping[str, object]) -> str:
    """Markdown table of names and values."""
    rows = [f"| {key.replace('_', ' ')} | {value} |" for key, value in values.items()]
    return "\n".join([f"| {title} | |", "|---|---|", *rows])
