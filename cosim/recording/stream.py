"""An open recording: its signals, how they are drawn, and the file."""

from __future__ import annotations

import atexit
import os
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice
from math import inf, isfinite
from pathlib import Path
from types import MappingProxyType
from typing import NoReturn, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cosim.core.errors import RecordingError
from cosim.core.files import check_target, publish
from cosim.core.protocols import Array
from cosim.recording.read import SAMPLE, SIGNAL, TIMELINE

SERIES = ("#3B94DE", "#E8731F", "#22AC7E", "#CC79A7", "#E5A11A", "#6CC3F0")
"""Colours of signals, in turn."""
BOUND_COLOR = "#D8392B"
# Ranges of the code points that the viewer's font has: Latin, Greek and Cyrillic, dashes.
_DRAWABLE = ((0x20, 0x24F), (0x370, 0x4FF), (0x2010, 0x2026))
# The end of a file that is whole has this word in its last bytes.
_FOOTER = b"RRF2FOOT"
_FOOTER_BYTES = len(_FOOTER) + 32
_WRITE_SECONDS = 30.0
# Streams whose writer does not answer: kept, since dropping one waits for its writer.
_ABANDONED: list[rr.RecordingStream] = []

Interval = tuple[float, float]
FREE = (-inf, inf)
"""Bounds of a signal that has none."""


@dataclass
class Channel:
    """A signal in a recording: its entity, how it is drawn, and the range `seen` of its values.

    `labels` name the lines of a signal with several numbers a row. `step` holds a value until the
    next one, `points` draws dots; `bounds` may be infinite; the range leaves out the share `tail`
    of the largest values.
    """

    entity: str
    name: str
    unit: str = ""
    color: str = SERIES[0]
    bounds: Interval = FREE
    labels: Sequence[str] = ()
    step: bool = False
    points: bool = False
    tail: float = 0.0
    seen: Interval = (inf, -inf)

    @property
    def title(self) -> str:
        """Name, unit and bounds in words: the viewer's font has no ≥."""
        parts = [self.name]
        if self.unit not in ("", "1"):
            parts = [f"{self.name} [{self.unit}]"]
        lower, upper = self.bounds
        if isfinite(lower):
            parts.append(f"at least {lower:g}")
        if isfinite(upper):
            parts.append(f"at most {upper:g}")
        return ", ".join(parts)

    def see(self, values: Array) -> None:
        """Widen the range seen by values of any shape."""
        finite = values[np.isfinite(values)]
        if not finite.size:
            return
        bottom = float(finite.min())
        top = float(finite.max())
        # A quantile takes many times as long as a maximum.
        if self.tail:
            top = float(np.quantile(finite, 1.0 - self.tail))
        low, high = self.seen
        self.seen = (min(low, bottom), max(high, top))

    def window(self) -> Interval | None:
        """Range of view: the values seen and each bound within their span; None before any."""
        low, high = self.seen
        if low > high:
            return None
        lower, upper = self.bounds
        # A signal that is constant has a span, too, and so has one that is 0.
        largest = max(abs(low), abs(high))
        span = max(high - low, 1e-3 * largest) or 1.0
        # A bound far away would press the signal into a line.
        if low - span <= lower:
            low = min(low, lower)
        if upper <= high + span:
            high = max(high, upper)
        margin = 0.06 * max(high - low, span)
        return low - margin, high + margin


class Stream:
    """An open recording: `send`, then `close`; an exception in its context discards it.

    `about` is the Markdown of the view `/about`; `properties` describe the run as a whole, shown in
    the viewer when the recording is selected. `layout` may be replaced before `close`.

    The file is written beside `path` under a hidden name and renamed by `close`, so that `path`
    never holds half a recording; `rerun rrd optimize` repairs what a killed process leaves. Raises
    OSError where the folder does not exist or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        name: str,
        about: str,
        properties: Mapping[str, object] = MappingProxyType({}),
        layout: rrb.Blueprint | None = None,
    ) -> None:
        self.path = check_target(path)
        self.layout = layout
        name_of_partial = f".{self.path.stem}.{secrets.token_hex(4)}.partial.rrd"
        self._partial = self.path.with_name(name_of_partial)
        self._partial.touch()
        # Otherwise a column of the wrong shape is dropped with a warning.
        rr.set_strict_mode(True)
        self.rerun = rr.RecordingStream("rti-cosim")
        self.rerun.send_recording_name(drawable(name))
        self._declared: set[str] = set()
        save = partial(self.rerun.save, self._partial, default_blueprint=layout)
        self._bounded(save)
        described = rr.AnyValues()
        for key, value in properties.items():
            described.with_component_from_data(key, drawable(str(value)))
        # Rerun refuses a property without values.
        if properties:
            self.rerun.send_property("run", described)
        markdown = rr.MediaType.MARKDOWN
        page = rr.TextDocument(drawable(about), media_type=markdown)
        self.rerun.log("about", page, static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def send(
        self,
        channels: Sequence[Channel],
        times: list[rr.TimeColumn],
        values: Array,
        ends: list[rr.TimeColumn] | None = None,
    ) -> None:
        """Send K rows of the signals of one entity.

        Args:
            channels: the signals.
            times: of the rows.
            values: (K,) or (K, labels) of one signal, (K, m) of m.
            ends: two times, between which finite bounds are drawn.
        """
        entity = channels[0].entity
        columns = values.T if len(channels) > 1 else [values]
        for channel, column in zip(channels, columns, strict=True):
            channel.see(column)
            if ends:
                lower, upper = channel.bounds
                self._send_bound(channel, "lower", lower, ends)
                self._send_bound(channel, "upper", upper, ends)
        self._declare(entity, channels)
        scalars = rr.Scalars.columns(scalars=values)
        self.rerun.send_columns(entity, times, scalars)

    def _declare(self, entity: str, channels: Sequence[Channel]) -> None:
        """Say once of an entity which signals it holds, and how they are drawn."""
        if entity in self._declared:
            return
        self._declared.add(entity)
        # `read_recording` finds the signals by this mark.
        names = [channel.name for channel in channels]
        units = [channel.unit for channel in channels]
        mark = rr.DynamicArchetype(
            SIGNAL,
            components={"name": names, "unit": units},
        )
        style = _style(channels)
        # Static: true of the whole run, and not of a moment.
        self.rerun.log(entity, mark, style, static=True)

    def _send_bound(
        self,
        channel: Channel,
        side: str,
        bound: float,
        ends: list[rr.TimeColumn],
    ) -> None:
        """Draw a signal's lower or upper bound between two times, if it is finite."""
        if not isfinite(bound):
            return
        entity = f"bounds/{channel.entity}/{side}"
        line = Channel(entity, f"{side} bound", color=BOUND_COLOR)
        style = _style([line])
        self.rerun.log(entity, style, static=True)
        # The same level at both times makes a line.
        level = rr.Scalars.columns(scalars=[bound, bound])
        self.rerun.send_columns(entity, ends, level)

    def close(self) -> None:
        """Finish the file, with the layout, and give it its name.

        Raises RecordingError where not all of it could be written.
        """
        if self.rerun in _ABANDONED:
            return
        if self.layout is not None:
            self.rerun.send_blueprint(self.layout)
        self._bounded(self.rerun.disconnect)
        # Rerun does not say that the disk was full: the file then lacks its footer.
        size = self._partial.stat().st_size
        with self._partial.open("rb") as written:
            written.seek(-min(_FOOTER_BYTES, size), os.SEEK_END)
            end = written.read()
        if _FOOTER not in end:
            self._give_up("its end is missing")
        publish(self._partial, self.path)

    def discard(self) -> None:
        """End the recording without a file."""
        if self.rerun not in _ABANDONED:
            self._bounded(self.rerun.disconnect)
            self._partial.unlink(missing_ok=True)

    def _bounded(self, call: Callable[[], None]) -> None:
        """Let Rerun write for a limited time: without its writer it would wait for ever."""
        writing = threading.Thread(target=call, daemon=True)
        writing.start()
        writing.join(_WRITE_SECONDS)
        if writing.is_alive():
            # Dropping the stream, or Rerun's shutdown, would wait for ever too.
            _ABANDONED.append(self.rerun)
            atexit.unregister(rr.rerun_shutdown)
            self._give_up("its writer does not answer")

    def _give_up(self, reason: str) -> NoReturn:
        raise RecordingError(
            f"the recording {self.path} could not be written ({reason}): is the disk full? Repair "
            f"what was written by: rerun rrd optimize {self._partial} -o REPAIRED.rrd"
        ) from None


def _style(channels: Sequence[Channel]) -> rr.SeriesLines | rr.SeriesPoints:
    """How the signals of one entity are drawn: their labels, colours, and lines or dots."""
    # Signals that share an entity are drawn alike.
    first = channels[0]
    colors = [channel.color for channel in channels]
    labels: Sequence[str] = [_legend(channel) for channel in channels]
    if first.labels:
        # One signal with several numbers a row: a line for each, all of unlike colours.
        labels = first.labels
        if len(labels) > 1:
            colors = list(islice(cycle(SERIES), len(labels)))
    names = [drawable(label) for label in labels]
    numbers = [packed_color(color) for color in colors]
    # An array, since Rerun misreads a list of three numbers as one colour.
    packed = np.array(numbers, dtype=np.uint32)
    if first.points:
        sizes = np.full(len(names), 4.0)
        return rr.SeriesPoints(names=names, colors=packed, marker_sizes=sizes)
    mode = rr.components.InterpolationMode.Linear
    if first.step:
        mode = rr.components.InterpolationMode.StepAfter
    return rr.SeriesLines(
        names=names,
        colors=packed,
        widths=np.full(len(names), 1.5),
        # The default average would hide the violations of a run that is wider than the screen.
        aggregation_policy=rr.components.AggregationPolicy.MinMax,
        interpolation_mode=mode,
    )


def _legend(channel: Channel) -> str:
    """A signal's title without its bounds."""
    return channel.title.partition(",")[0]


def packed_color(color: str) -> int:
    """`#RRGGBB` as the opaque 32-bit number that Rerun takes."""
    red_green_blue = color.removeprefix("#")
    return int(f"{red_green_blue}FF", 16)


def drawable(text: str) -> str:
    """Replace by `?` each character that the viewer's font lacks: the headless viewer aborts."""
    characters = []
    for character in text:
        is_drawable = character == "\n" or _is_in_font(character)
        characters.append(character if is_drawable else "?")
    return "".join(characters)


def _is_in_font(character: str) -> bool:
    """Whether the viewer's font has a character."""
    code = ord(character)
    return any(low <= code <= high for low, high in _DRAWABLE)


def times(
    samples: Sequence[int] | np.ndarray,
    time: Array | None = None,
) -> list[rr.TimeColumn]:
    """Index columns of K rows.

    Args:
        samples: their numbers, (K,).
        time: in s, (K,), recorded to 1 ns; None where there is none.
    """
    numbers = np.asarray(samples, dtype=np.int64)
    by_sample = rr.TimeColumn(SAMPLE, sequence=numbers)
    if time is None:
        return [by_sample]
    # Rounded: a cast alone would cut a time that is a little below its nanosecond.
    nanoseconds = np.rint(time * 1e9)
    durations = nanoseconds.astype("timedelta64[ns]")
    by_time = rr.TimeColumn(TIMELINE, duration=durations)
    return [by_sample, by_time]
