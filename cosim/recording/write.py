"""Writes recordings: a run part by part, ended runs over each other, a training."""

from __future__ import annotations

import atexit
import os
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from itertools import chain, cycle, islice
from math import inf, isfinite
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NoReturn, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun import escape_entity_path_part as escaped

from cosim.core.errors import RecordingError
from cosim.core.files import check_target, publish
from cosim.core.loop import controller_name
from cosim.core.protocols import Array, Controller
from cosim.core.result import markdown_table
from cosim.core.scenario import Scenario
from cosim.core.trajectory import SIGNALS, RunSignals, SignalKind
from cosim.recording.read import SAMPLE, SIGNAL, TIMELINE

if TYPE_CHECKING:
    from learning.training import Training

SERIES = ("#3B94DE", "#E8731F", "#22AC7E", "#CC79A7", "#E5A11A", "#6CC3F0")
BOUND_COLOR = "#D8392B"
# Ranges of the code points that the viewer's font has: Latin, Greek and Cyrillic, dashes.
_DRAWABLE = ((0x20, 0x24F), (0x370, 0x4FF), (0x2010, 0x2026))
# The end of a file that is whole has this word in its last bytes.
_FOOTER = b"RRF2FOOT"
_FOOTER_BYTES = len(_FOOTER) + 32
_WRITE_SECONDS = 30.0
# Streams whose writer does not answer: kept, since dropping one waits for its writer.
_ABANDONED: list[rr.RecordingStream] = []

AT = rr.TimeRangeBoundary.absolute
Interval = tuple[float, float]

ALONE = ("states", "actions", "sensors", "costs")
"""Groups with an entity for each signal; those of the others share one, which takes less space."""
HELD = ("actions", "disturbances", "signals")
FREE = (-inf, inf)
_STATUS_ENTITY = "solver/status"
_RESIDUAL = "solver/log_residual"
_GOOD = "#3A9A5B"


class RerunRecorder:
    """Recorder of `simulate`: a `.rrd` file with layout, signals, predictions and run properties.

    Every signal keeps its name and float64 bits; `read_recording` gives them back. Predictions are
    the signals `prediction/<name>`, N+1 or N numbers a sample. A plant that is made with
    `intermediate=recorder.intermediate` has its states within the samples recorded, too.

    Raises OSError where the file cannot be begun, RecordingError where it is not written whole.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stream: Stream | None = None
        self._within: list[tuple[float, ...]] = []

    def start(
        self,
        scenario: Scenario,
        controller: Controller,
        seed: int,
        steps: int,
        units: dict[str, str],
    ) -> None:
        """Open the file; write layout and properties.

        Args:
            scenario: of the run.
            controller: of the run; its name and the hash of its θ are properties.
            seed: of the disturbances.
            steps: samples of the whole run, for the time axis.
            units: unit of each FMU variable by name.
        """
        name = controller_name(controller)
        parameters = getattr(controller, "parameters", None)
        self._seconds = steps * scenario.sampling_time
        self._kinds = {}
        for kind in SIGNALS:
            if kind.group is not None:
                self._kinds[kind] = _channels(kind, scenario, units)
        self._predicted = {}
        for group in ("states", "actions"):
            channels = [_predicted_channel(channel) for channel in self._group(group)]
            self._predicted[f"predicted_{group}"] = channels
        self._fine = []
        for channel, color in zip(self._group("states"), cycle(SERIES[2:]), strict=False):
            entity = f"intermediate/{escaped(channel.name)}"
            self._fine.append(replace(channel, entity=entity, color=color, labels=["within"]))
        self._residual = Channel(_RESIDUAL, "log10 of the KKT residual", color=SERIES[2])
        self._status: str | None = None
        # A forecast may have driven the plant already.
        self._within.clear()
        # Of each signal the state whose bound it is; empty where it is none.
        self._bounded_by = {}
        for signal, title in zip(scenario.valued_signals, scenario.signal_names, strict=True):
            self._bounded_by[title] = signal.bounded_state
        properties = {
            "scenario": scenario.name,
            "scenario_hash": scenario.hash,
            "controller": name,
            "theta_hash": getattr(parameters, "hash", "none"),
            "seed": seed,
            "steps": steps,
            "sampling_time": f"{scenario.sampling_time:g} s",
            "fmu": Path(scenario.plant.fmu).name,
            "package": f"rti-cosim {version('rti-cosim')}",
        }
        title = f"{name} on {scenario.name}, seed {seed}"
        about = _about(scenario, properties)
        self._stream = Stream(self.path, title, about, properties, self._layout())
        solved = rr.StateConfiguration(values=["solved"], colors=[packed_color(_GOOD)])
        self._stream.rerun.log(_STATUS_ENTITY, solved, static=True)

    def record(self, first: int, columns: Mapping[str, Array], status: Sequence[str]) -> None:
        """Append K samples: one column of K rows for each signal.

        Args:
            first: number of the first sample.
            columns: values by the names of `SIGNALS`, (K,), or (K, n) of a vector, and predictions,
                (K, N+1 or N, n).
            status: the solver's status of each sample.
        """
        stream = self._stream
        if stream is None:
            return
        time = columns["time"]
        samples = np.arange(first, first + len(status))
        rows = times(samples, time)
        # Bounds are lines from the first sample to the last.
        ends = times(samples[[0, -1]], time[[0, -1]])
        self._record_signals(stream, columns, rows, ends)
        self._record_residual(stream, columns["residual"], rows)
        self._record_status(stream, samples, time, status)
        self._record_predictions(stream, columns, rows)
        self._record_intermediate(stream, samples, time)

    def _record_signals(
        self,
        stream: Stream,
        columns: Mapping[str, Array],
        rows: list[rr.TimeColumn],
        ends: list[rr.TimeColumn],
    ) -> None:
        """Send the signals, those of one entity together."""
        channels_of: dict[str, list[Channel]] = {}
        values_of: dict[str, list[Array]] = {}
        for kind, channels in self._kinds.items():
            column = columns[kind.name]
            # A vector's entries are channels of their own.
            entries = column.reshape(len(column), -1).T
            for channel, values in zip(channels, entries, strict=True):
                channels_of.setdefault(channel.entity, []).append(channel)
                values_of.setdefault(channel.entity, []).append(values)
        for entity, channels in channels_of.items():
            values = np.column_stack(values_of[entity])
            stream.send(channels, rows, values, ends)

    def _record_residual(
        self,
        stream: Stream,
        residual: Array,
        rows: list[rr.TimeColumn],
    ) -> None:
        """Send the logarithm of the KKT residual, (K,): it ranges over many powers of ten."""
        # A solution may be exact, and a failed one has no residual.
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.log10(residual)
        self._residual.see(logarithm)
        scalars = rr.Scalars.columns(scalars=logarithm)
        stream.rerun.send_columns(_RESIDUAL, rows, scalars)

    def _record_predictions(
        self,
        stream: Stream,
        columns: Mapping[str, Array],
        rows: list[rr.TimeColumn],
    ) -> None:
        """Send what the solutions predict: a channel for each state or action."""
        for name, channels in self._predicted.items():
            # A controller need not predict anything.
            if name not in columns:
                continue
            # (K, stages, n) to n times (K, stages): a channel has a line for each stage.
            entries = np.moveaxis(columns[name], 2, 0)
            for channel, values in zip(channels, entries, strict=False):
                n_stages = values.shape[1]
                channel.labels = [f"+{stage}" for stage in range(n_stages)]
                stream.send([channel], rows, values)

    def _record_status(
        self, stream: Stream, samples: NDArray[np.int64], time: Array, status: Sequence[str]
    ) -> None:
        """Send the status of the samples at which it is another than before.

        The viewer draws a status until the next one; most runs have one status throughout.
        """
        changes = []
        for row, word in enumerate(status):
            if word != self._status:
                changes.append(row)
            self._status = word
        if not changes:
            return
        words = [drawable(status[row]) for row in changes]
        states = rr.StateChange.columns(state=words)
        rows = times(samples[changes], time[changes])
        stream.rerun.send_columns(_STATUS_ENTITY, rows, states)

    def _record_intermediate(self, stream: Stream, samples: NDArray[np.int64], time: Array) -> None:
        """Send what `intermediate` took since the last call."""
        if not self._within:
            return
        moments, *states = np.array(self._within).T
        self._within.clear()
        # A state at the end of a sample counts to that sample.
        next_row = np.searchsorted(time, moments)
        row = np.maximum(next_row - 1, 0)
        rows = times(samples[row], moments)
        for channel, values in zip(self._fine, states, strict=True):
            stream.send([channel], rows, values)

    def intermediate(self, time: float, states: Array) -> None:
        """Take the states within a sample.

        Args:
            time: in s.
            states: (n,).
        """
        self._within.append((time, *states.tolist()))

    def close(self) -> None:
        """Finish the file with the ranges that the run has filled; no sample, no file."""
        if self._stream is not None:
            if self._status is not None:
                self._stream.layout = self._layout()
                self._stream.close()
            else:
                self._stream.discard()
            self._stream = None

    def _group(self, *groups: str) -> list[Channel]:
        """The channels of the signals of these groups."""
        selected = []
        for kind, channels in self._kinds.items():
            if kind.group in groups:
                selected += channels
        return selected

    def _layout(self) -> rrb.Blueprint:
        """Left: states and actions with bounds; middle: costs, causes, solver; right: the rest."""
        along = axis(AT(seconds=0.0), AT(seconds=self._seconds))
        left = [self._loop_view(channel, along) for channel in self._group("states", "actions")]
        middle: list[rrb.View] = []
        for sensor in self._group("sensors"):
            # A signal that is no bound of a state has a view of its own.
            if self._bounded_by.get(sensor.name) == "":
                middle.append(view(sensor.title, [sensor], along))
        for channel in self._group("costs"):
            middle.append(view(channel.title, [channel], along))
        middle.append(view("disturbances", self._group("disturbances"), along))
        middle.append(view("prepare and feedback time [s]", self._group("step_time"), along))
        middle.append(view(self._residual.name, [self._residual], along))
        status = rrb.StateTimelineView(
            name="QP status",
            contents=[f"/{_STATUS_ENTITY}"],
            time_view=along,
        )
        middle.append(status)
        columns = rrb.Horizontal(
            rrb.Vertical(*left),
            rrb.Vertical(*middle),
            self._right_column(along),
            column_shares=[4, 3, 3],
        )
        return layout(columns)

    def _loop_view(self, channel: Channel, along: rrb.TimeAxis) -> rrb.TimeSeriesView:
        """The plot of a state or an action, with all that is known of it beside its samples."""
        drawn = [channel]
        # States within a sample lie in the view of the state, where a run has any.
        for fine in self._fine:
            if fine.name == channel.name and fine.window():
                drawn.append(fine)
        # What is measured and estimated of a state is drawn over it.
        known = (f"measured[{channel.name}]", f"estimated[{channel.name}]")
        for sensor in self._group("sensors"):
            # So is a bound that moves.
            is_its_bound = self._bounded_by.get(sensor.name) == channel.name
            if sensor.name in known or is_its_bound:
                drawn.append(sensor)
        return view(channel.title, drawn, along)

    def _right_column(self, along: rrb.TimeAxis) -> rrb.TextDocumentView | rrb.Tabs:
        """The page about the run, behind the predictions where there are any."""
        page = rrb.TextDocumentView(name="about this run", origin="/about")
        predictions = []
        for channel in chain(*self._predicted.values()):
            if channel.window():
                predictions.append(view(channel.title, [channel], along, legend=False))
        if not predictions:
            return page
        return rrb.Tabs(rrb.Vertical(*predictions, name="predictions"), page)


def _channels(kind: SignalKind, scenario: Scenario, units: Mapping[str, str]) -> list[Channel]:
    """The signals of a kind as they are drawn; a unit not known is left empty."""
    # What is drawn into one view has unlike colours.
    first_color = {"actions": 2, "measurements": 2, "estimates": 4}.get(kind.name, 0)
    colors = cycle(SERIES[first_color:])
    channels = []
    # A bound that moves is drawn as a signal, not as a line.
    moving = {signal.bounded_state for signal in scenario.signals or ()}
    for name, unit in kind.units(scenario, units).items():
        entity = str(kind.group)
        if kind.group in ALONE:
            entity = f"{kind.group}/{escaped(name)}"
        is_bounded = bool(kind.vector) and name not in moving
        second_of_its_view = name in ("penalty", "feedback_time")
        channel = Channel(
            entity=entity,
            name=name,
            unit=unit,
            color=SERIES[1] if second_of_its_view else next(colors),
            bounds=scenario.limits.get(name, FREE) if is_bounded else FREE,
            step=kind.name in HELD,
            # The first solves of a run take many times as long as the others.
            tail=0.05 if kind.clock else 0.0,
        )
        channels.append(channel)
    return channels


def _predicted_channel(channel: Channel) -> Channel:
    """The prediction of a signal, as it is drawn."""
    return Channel(
        entity=f"prediction/{escaped(channel.name)}",
        name=f"prediction/{channel.name}",
        unit=channel.unit,
    )


def _about(scenario: Scenario, properties: Mapping[str, object]) -> str:
    return f"""# {scenario.name}

{scenario.description}

{_table("run", properties)}

**Time** is the plant's. Sample k of a state is what the controller measured; the input,
disturbance and cost of sample k hold until sample k+1. The cost per sample is economic cost +
penalty of violating the state bounds (red lines).

**Predictions**: line +i is the QP's prediction, made at the cursor, of the sample i later.
"""


def record_overlay(path: str | Path, runs: Mapping[str, RunSignals], about: str) -> None:
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
    time_of = {name: _time_of(run) for name, run in runs.items()}
    seconds = 0.0
    for time in time_of.values():
        if len(time):
            seconds = max(seconds, float(time[-1]))
    along = axis(AT(seconds=0.0), AT(seconds=seconds))
    last = max(len(run) for run in runs.values()) - 1
    ends = times([0, last], np.array([0.0, seconds]))
    title = " / ".join(runs)
    overlaid = []
    differences = []
    with Stream(path, title, about) as stream:
        for signal in first.signals:
            # Time is the axis of all others.
            if signal == "time" or not all(signal in run.signals for run in others):
                continue
            lines = _overlaid_lines(runs, signal)
            for line, (name, run) in zip(lines, runs.items(), strict=True):
                values = run.signals[signal].values
                stream.send([line], _sample_times(time_of[name]), values, ends)
            # The title has the unit and the bounds, but no run's name.
            titled = replace(lines[0], name=signal)
            overlaid.append(view(titled.title, lines, along))
            # A difference of more than two runs would need one to compare with.
            if len(runs) == 2:
                line = _send_difference(stream, first, others[0], signal)
                differences.append(view(line.title, [line], along))
        stream.layout = _tabs({title: overlaid, "difference": differences})


def _send_difference(stream: Stream, one: RunSignals, other: RunSignals, signal: str) -> Channel:
    """Send a signal of one run less that of the other, and return how it is drawn."""
    line = Channel(
        entity=f"difference/{escaped(signal)}",
        name=f"difference/{signal}",
        unit=one.signals[signal].unit,
        color=SERIES[3],
    )
    values = _signal_difference(one.signals[signal].values, other.signals[signal].values)
    time = _time_of(one)[: len(values)]
    stream.send([line], _sample_times(time), values)
    return line


def _sample_times(time: Array) -> list[rr.TimeColumn]:
    """Index columns of the samples from the first on, at K times [s]."""
    return times(np.arange(len(time)), time)


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
        # The bounds of the others would lie on those of the first.
        bounds = FREE if lines else run.bounds.get(signal, FREE)
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
    with np.errstate(invalid="ignore"):
        difference: Array = one[:common] - other[:common]
    return difference


def _tabs(tabs: Mapping[str, Sequence[rrb.View]], timeline: str = TIMELINE) -> rrb.Blueprint:
    """A tab for each title with its views in a grid, where it has any, and the page about it."""
    grids = []
    for name, views in tabs.items():
        if views:
            grids.append(rrb.Grid(*views, grid_columns=3, name=name))
    page = rrb.TextDocumentView(name="about", origin="/about")
    return layout(rrb.Tabs(*grids, page), timeline)


def record_training(path: str | Path, training: Training) -> None:
    """Write a recording of a training.

    The signals are the log's columns and `increment/<block>`, the change of a block of θ since the
    start, (K, size).

    Args:
        path: of the file.
        training: what `train` returned.

    Raises:
        OSError: if the file cannot be begun.
        RecordingError: if it is not written whole.
    """
    run = training.run
    log = training.log()
    properties = {
        "algorithm": run.algorithm,
        "scenario": run.scenario.name,
        "scenario_hash": run.scenario.hash,
        "samples": run.samples,
        "seed": run.seed,
        **run.configuration.model_dump(mode="json"),
    }
    samples = log["samples"].astype(np.int64)
    rows = times(samples)
    last = int(samples[-1]) if len(samples) else 0
    along = axis(AT(seq=0), AT(seq=last))
    title = f"{run.algorithm} on {run.scenario.name}"
    page = f"# {title}\n\n{_table('training', properties)}"
    blocks = training.parameters.blocks
    theta_views = []
    log_views = []
    with Stream(path, title, page, properties) as stream:
        for name, values in training.theta().items():
            labels = list(blocks.labels[blocks.slices[name]])
            block = Channel(f"increment/{escaped(name)}", f"increment/{name}", labels=labels)
            stream.send([block], rows, values)
            theta_views.append(view(f"change of {name}", [block], along))
        for (name, values), color in zip(log.items(), cycle(SERIES), strict=False):
            # What is not measured at every row is drawn as dots.
            sparse = bool(np.isnan(values).any())
            column = Channel(f"log/{escaped(name)}", name, color=color, points=sparse)
            stream.send([column], rows, values)
            log_views.append(view(name, [column], along))
        stream.layout = _tabs({"θ": theta_views, "log": log_views}, SAMPLE)


# The file, its signals and its layout


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
        has_unit = self.unit not in ("", "1")
        parts = [f"{self.name} [{self.unit}]" if has_unit else self.name]
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
        bottom = finite.min()
        # A quantile takes many times as long as a maximum.
        top = np.quantile(finite, 1.0 - self.tail) if self.tail else finite.max()
        low, high = self.seen
        self.seen = (min(low, float(bottom)), max(high, float(top)))

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
        self._bounded(partial(self.rerun.save, self._partial, default_blueprint=layout))
        described = rr.AnyValues()
        for key, value in properties.items():
            described.with_component_from_data(key, drawable(str(value)))
        # Rerun refuses a property without values.
        if properties:
            self.rerun.send_property("run", described)
        page = rr.TextDocument(drawable(about), media_type=rr.MediaType.MARKDOWN)
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
        self.rerun.send_columns(entity, times, rr.Scalars.columns(scalars=values))

    def _declare(self, entity: str, channels: Sequence[Channel]) -> None:
        """Say once of an entity which signals it holds, and how they are drawn."""
        if entity in self._declared:
            return
        self._declared.add(entity)
        # `read_recording` finds the signals by this mark.
        names = [channel.name for channel in channels]
        units = [channel.unit for channel in channels]
        mark = rr.DynamicArchetype(SIGNAL, components={"name": names, "unit": units})
        self.rerun.log(entity, mark, _style(channels), static=True)

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
        self.rerun.log(entity, _style([line]), static=True)
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
    first = channels[0]
    colors = [channel.color for channel in channels]
    labels: Sequence[str] = [_legend(channel) for channel in channels]
    if first.labels:
        # One signal with several numbers a row: a line for each, all of unlike colours.
        labels = first.labels
        if len(labels) > 1:
            colors = list(islice(cycle(SERIES), len(labels)))
    names = [drawable(label) for label in labels]
    # An array, since Rerun misreads a list of three numbers as one colour.
    packed = np.array([packed_color(color) for color in colors], dtype=np.uint32)
    if first.points:
        sizes = np.full(len(names), 4.0)
        return rr.SeriesPoints(names=names, colors=packed, marker_sizes=sizes)
    mode = rr.components.InterpolationMode
    return rr.SeriesLines(
        names=names,
        colors=packed,
        widths=np.full(len(names), 1.5),
        # The default average would hide the violations of a run that is wider than the screen.
        aggregation_policy=rr.components.AggregationPolicy.MinMax,
        interpolation_mode=mode.StepAfter if first.step else mode.Linear,
    )


def _legend(channel: Channel) -> str:
    """A signal's title without its bounds."""
    return channel.title.partition(",")[0]


def packed_color(color: str) -> int:
    """`#RRGGBB` as the opaque 32-bit number that Rerun takes."""
    return int(color.removeprefix("#") + "FF", 16)


def drawable(text: str) -> str:
    """Replace by `?` each character that the viewer's font lacks: the headless viewer aborts."""
    characters = []
    for character in text:
        characters.append(character if _is_drawable(character) else "?")
    return "".join(characters)


def _is_drawable(character: str) -> bool:
    if character == "\n":
        return True
    code = ord(character)
    return any(low <= code <= high for low, high in _DRAWABLE)


def times(samples: Sequence[int] | np.ndarray, time: Array | None = None) -> list[rr.TimeColumn]:
    """Index columns of K rows.

    Args:
        samples: their numbers, (K,).
        time: in s, (K,), recorded to 1 ns; None where there is none.
    """
    numbers = np.asarray(samples, dtype=np.int64)
    by_sample = rr.TimeColumn(SAMPLE, sequence=numbers)
    if time is None:
        return [by_sample]
    nanoseconds = np.rint(time * 1e9).astype("timedelta64[ns]")
    by_time = rr.TimeColumn(TIMELINE, duration=nanoseconds)
    return [by_sample, by_time]


def axis(start: rr.TimeRangeBoundary, end: rr.TimeRangeBoundary) -> rrb.TimeAxis:
    """Horizontal axis over a whole run."""
    return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))


def view(
    title: str, channels: Sequence[Channel], along: rrb.TimeAxis, *, legend: bool | None = None
) -> rrb.TimeSeriesView:
    """A plot of signals and their bounds, in the range of view of all of them.

    Args:
        title: of the plot.
        channels: the signals.
        along: the horizontal axis.
        legend: whether it is drawn; by default where there are several signals.
    """
    lows = []
    highs = []
    for channel in channels:
        window = channel.window()
        # A channel without values has no say in the range.
        if window is None:
            continue
        low, high = window
        lows.append(low)
        highs.append(high)
    contents = []
    for entity in dict.fromkeys(channel.entity for channel in channels):
        contents += [f"/{entity}", f"/bounds/{entity}/**"]
    ordinate = None
    if lows:
        ordinate = rrb.ScalarAxis(range=(min(lows), max(highs)))
    if legend is None:
        legend = len(channels) > 1
    return rrb.TimeSeriesView(
        name=drawable(title),
        origin="/",
        contents=contents,
        axis_x=along,
        axis_y=ordinate,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
    )


def layout(root: rrb.Container, timeline: str = TIMELINE) -> rrb.Blueprint:
    """The layout of a recording, with no other panels in the way.

    Args:
        root: the views.
        timeline: that of the time panel, which is paused.
    """
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused"),
    )


def _table(title: str, values: Mapping[str, object]) -> str:
    rows = []
    for key, value in values.items():
        rows.append((key.replace("_", " "), str(value)))
    return markdown_table((title, ""), rows)
