"""A Rerun file that is written in blocks of columns and appears only when it is whole."""

from __future__ import annotations

import atexit
import os
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import inf
from pathlib import Path
from typing import NoReturn

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cosim.errors import RecordingError
from cosim.files import make_public
from cosim.recording.channels import Channel, Range
from cosim.recording.glyphs import drawable
from cosim.recording.palette import packed_all

APPLICATION = "rti-cosim"
SIGNAL = "cosim.Signal"
"""Archetype of the static mark (name, unit) on every entity that holds a signal."""

FOOTER = b"RRF2FOOT"
"""Near the end of every file that Rerun finished."""

WRITE_SECONDS = 30.0
_ABANDONED: list[rr.RecordingStream] = []

TIME = "time"
SAMPLE = "sample"


class Stream:
    """An open recording; use `static`, `scalars` and `columns`, then `close`.

    What is sent before the first `layout` waits in memory, since a layout must stand first in the
    file. The file is written beside `path` under a hidden name and renamed by `close`, so that
    `path` never holds half a recording; `rerun rrd optimize` repairs what a killed process leaves.

    Raises
    ------
    RecordingError : the folder does not exist or cannot be written.
    """

    def __init__(self, path: str | Path, name: str) -> None:
        self.path = Path(path)
        try:
            handle, name_of_partial = tempfile.mkstemp(
                dir=self.path.parent, prefix=f".{self.path.stem}.", suffix=".partial.rrd"
            )
            os.close(handle)
        except OSError as error:
            raise RecordingError(
                f"cannot write the recording {self.path}: {error.strerror}"
            ) from None
        self._partial = Path(name_of_partial)
        # Without it a column of the wrong shape is dropped with no more than a warning.
        rr.set_strict_mode(True)
        self._stream = rr.RecordingStream(APPLICATION)
        self._stream.send_recording_name(drawable(name))
        self._shown: dict[str, Range] = {}
        self.begun = False

    def properties(self, group: str, values: Mapping[str, object]) -> None:
        """Describe the run as a whole; shown in the viewer when the recording is selected."""
        described = rr.AnyValues()
        for key, value in values.items():
            described.with_component_from_data(key, drawable(str(value)))
        self._stream.send_property(group, described)

    def static(self, entity: str, *archetypes: rr.AsComponents) -> None:
        """Log what does not change over time."""
        self._stream.log(entity, *archetypes, static=True)

    def columns(
        self, entity: str, times: list[rr.TimeColumn], columns: rr.ComponentColumnList
    ) -> None:
        """Send a block of rows."""
        self._stream.send_columns(entity, times, columns)

    def scalars(self, entity: str, times: list[rr.TimeColumn], values: NDArray[np.float64]) -> None:
        """Send a block of one signal, (K,), or of K vectors, (K, m)."""
        self.columns(entity, times, rr.Scalars.columns(scalars=values))

    def layout(self, blueprint: rrb.Blueprint, channels: Sequence[Channel]) -> None:
        """Give the views of these channels, with the ranges that they have by now."""
        self._shown = {channel.entity + channel.name: channel.window() for channel in channels}
        if self.begun:
            self._stream.send_blueprint(blueprint)
        else:
            self._bounded(partial(self._stream.save, self._partial, default_blueprint=blueprint))
            self.begun = True

    def outgrown(self, channels: Sequence[Channel]) -> bool:
        """Whether a channel is not in the layout, or has values outside its range there."""
        ranges = [self._shown.get(c.entity + c.name, (inf, -inf)) for c in channels]
        pairs = zip(channels, ranges, strict=True)
        return self.begun and any(c.seen[0] < low or c.seen[1] > high for c, (low, high) in pairs)

    def close(self) -> None:
        """Finish the file and give it its name; without a layout there is none.

        Raises RecordingError where not all of it could be written.
        """
        if self._stream in _ABANDONED:
            return
        if not self.begun:
            self._partial.unlink()
            return
        self._bounded(self._stream.disconnect)
        with self._partial.open("rb") as written:
            written.seek(-min(len(FOOTER) + 32, self._partial.stat().st_size), os.SEEK_END)
            if FOOTER not in written.read():
                self._give_up("its end is missing")
        make_public(self._partial)
        self._partial.replace(self.path)

    def _bounded(self, call: Callable[[], None]) -> None:
        """Let Rerun write, for a time: once its writer has ended, it waits for it for ever."""
        writing = threading.Thread(target=call, daemon=True)
        writing.start()
        writing.join(WRITE_SECONDS)
        if writing.is_alive():
            # To drop the stream, or to let Rerun shut down, would wait for ever too.
            _ABANDONED.append(self._stream)
            atexit.unregister(rr.rerun_shutdown)
            self.begun = False
            self._give_up("its writer does not answer")

    def _give_up(self, reason: str) -> NoReturn:
        raise RecordingError(
            f"the recording {self.path} could not be written ({reason}): is the disk full? What "
            f"was written can be repaired: rerun rrd optimize {self._partial} -o REPAIRED.rrd"
        ) from None


def line(label: str, color: str, *, step: bool = False, width: float = 1.5) -> rr.SeriesLines:
    """Style of one line; `step` holds each value until the next one (inputs, disturbances)."""
    return lines([label], [color], step=step, width=width)


def lines(
    labels: Sequence[str], colors: Sequence[str], *, step: bool = False, width: float = 1.5
) -> rr.SeriesLines:
    """Style of the lines of an entity with several numbers a row."""
    mode, policy = rr.components.InterpolationMode, rr.components.AggregationPolicy
    return rr.SeriesLines(
        names=[drawable(label) for label in labels],
        colors=packed_all(colors),
        widths=np.full(len(labels), width),
        # The default average would hide the violations of a run that is wider than the screen.
        aggregation_policy=policy.MinMax,
        interpolation_mode=mode.StepAfter if step else mode.Linear,
    )


def mark(names: Sequence[str], units: Sequence[str]) -> rr.DynamicArchetype:
    """Static mark of an entity that holds signals, by which `read_recording` finds them.

    Its rows have one number per name, or as many more as they divide into evenly.
    """
    return rr.DynamicArchetype(SIGNAL, components={"name": list(names), "unit": list(units)})


def sample_times(samples: NDArray[np.int64], time: NDArray[np.float64]) -> list[rr.TimeColumn]:
    """Index columns of K rows: the sample numbers and the time in s, rounded to 1 ns."""
    return [
        rr.TimeColumn(TIME, duration=np.rint(time * 1e9).astype("timedelta64[ns]")),
        rr.TimeColumn(SAMPLE, sequence=samples),
    ]
