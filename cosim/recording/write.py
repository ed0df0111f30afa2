"""Writes recordings: a run part by part, ended runs over each other, a training."""

from __future__ import annotations

import atexit
import os
import secrets
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from itertools import chain, cycle
from math import inf, isfinite
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn, Self

import numpy as np
import pyarrow
import rerun as rr
import rerun.blueprint as rrb
from rerun import escape_entity_path_part as escaped

from cosim.comparison import RunSignals
from cosim.errors import RecordingError
from cosim.files import check_target, publish
from cosim.protocols import Array, Controller
from cosim.recording.read import SAMPLE, SIGNAL, TIME
from cosim.result import markdown_table
from cosim.scenario import Scenario
from cosim.simulation import controller_name
from cosim.trajectory import SIGNALS, SignalKind

if TYPE_CHECKING:
    from learning.training import Training

SERIES = ("#3B94DE", "#E8731F", "#22AC7E", "#CC79A7", "#E5A11A", "#6CC3F0")
BOUND = "#D8392B"
_DRAWABLE = ((0x20, 0x24F), (0x370, 0x4FF), (0x2010, 0x2026))
_FOOTER = b"RRF2FOOT"
_WRITE_SECONDS = 30.0
_ABANDONED: list[rr.RecordingStream] = []

AT = rr.TimeRangeBoundary.absolute
Range = tuple[float, float]

ALONE = ("states", "actions", "costs")
"""Groups with an entity for each signal; those of the others share one, which takes less space."""
HELD = ("actions", "disturbances")
FREE = (-inf, inf)
_STATUS, _RESIDUAL = "solver/status", "solver/log_residual"
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
        """Open the file; write layout and properties."""
        name = controller_name(controller)
        self._seconds = steps * scenario.sampling_time
        recorded = [kind for kind in SIGNALS if kind.group is not None]
        self._kinds = {kind: _channels(kind, scenario, units) for kind in recorded}
        self._predicted = {
            f"predicted_{group}": [
                Channel(f"prediction/{escaped(c.name)}", f"prediction/{c.name}", c.unit)
                for c in self._group(group)
            ]
            for group in ("states", "actions")
        }
        self._fine = [
            replace(c, entity=f"intermediate/{escaped(c.name)}", color=color, labels=["within"])
            for c, color in zip(self._group("states"), cycle(SERIES[2:]), strict=False)
        ]
        self._residual = Channel(_RESIDUAL, "log10 of the KKT residual", color=SERIES[2])
        self._status: str | None = None
        properties = {
            "scenario": scenario.name,
            "scenario_hash": scenario.hash,
            "controller": name,
            "theta_hash": getattr(getattr(controller, "parameters", None), "hash", "none"),
            "seed": seed,
            "steps": steps,
            "sampling_time": f"{scenario.sampling_time:g} s",
            "fmu": Path(scenario.plant.fmu).name,
            "package": f"rti-cosim {version('rti-cosim')}",
        }
        title = f"{name} on {scenario.name}, seed {seed}"
        about = _about(scenario, properties)
        stream = self._stream = Stream(self.path, title, about, properties, self._layout())
        good = rr.StateConfiguration(values=["solved"], colors=[packed_color(_GOOD)])
        stream.rerun.log(_STATUS, good, static=True)

    def record(self, first: int, columns: Mapping[str, Array], status: Sequence[str]) -> None:
        """Append K samples: one column of K rows for each signal."""
        stream = self._stream
        if stream is None:
            return
        samples, time = np.arange(first, first + len(status)), columns["time"]
        rows, ends = times(samples, time), times(samples[[0, -1]], time[[0, -1]])
        bundles: dict[str, list[tuple[Channel, Array]]] = {}
        for kind, channels in self._kinds.items():
            own = columns[kind.name].reshape(len(status), -1).T
            for channel, values in zip(channels, own, strict=True):
                bundles.setdefault(channel.entity, []).append((channel, values))
        for bundle in bundles.values():
            members, parts = zip(*bundle, strict=True)
            stream.send(members, rows, np.column_stack(parts), ends)
        with np.errstate(divide="ignore", invalid="ignore"):
            residual = np.log10(columns["residual"])
        stream.rerun.send_columns(_RESIDUAL, rows, rr.Scalars.columns(scalars=residual))
        self._residual.see(residual)
        before, self._status = [self._status, *status[:-1]], status[-1]
        if changes := [i for i, word in enumerate(status) if word != before[i]]:
            states = rr.StateChange.columns(state=[drawable(status[i]) for i in changes])
            stream.rerun.send_columns(_STATUS, times(samples[changes], time[changes]), states)
        for name, channels in self._predicted.items():
            stages: Any = np.moveaxis(columns[name], 2, 0) if name in columns else []
            for channel, values in zip(channels, stages, strict=False):
                channel.labels = [f"+{stage}" for stage in range(values.shape[1])]
                stream.send([channel], rows, values)
        if self._within:
            moments, *within = np.array(self._within).T
            self._within.clear()
            # A state at the end of a sample counts to that sample.
            rows = times(samples[np.maximum(np.searchsorted(time, moments) - 1, 0)], moments)
            for channel, values in zip(self._fine, within, strict=True):
                stream.send([channel], rows, values)

    def intermediate(self, time: float, states: Array) -> None:
        """Take the states (n,) at a time [s] within a sample."""
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
        return [
            c for kind, channels in self._kinds.items() if kind.group in groups for c in channels
        ]

    def _layout(self) -> rrb.Blueprint:
        """Left: states and actions with bounds; middle: costs, causes, solver; right: the rest."""
        along = axis(AT(seconds=0.0), AT(seconds=self._seconds))
        loop = [
            view(c.title, [c, *(f for f in self._fine if f.name == c.name and f.window())], along)
            for c in self._group("states", "actions")
        ]
        causes = [
            *(view(c.title, [c], along) for c in self._group("costs")),
            view("disturbances", self._group("disturbances"), along),
            view("prepare and feedback time [s]", self._group("step_time"), along),
            view(self._residual.name, [self._residual], along),
            rrb.StateTimelineView(name="QP status", contents=[f"/{_STATUS}"], time_view=along),
        ]
        about = rrb.TextDocumentView(name="about this run", origin="/about")
        predicted = [
            view(c.title, [c], along, legend=False)
            for c in chain(*self._predicted.values())
            if c.window()
        ]
        right = rrb.Tabs(rrb.Vertical(*predicted, name="predictions"), about)
        return layout(
            rrb.Horizontal(
                rrb.Vertical(*loop),
                rrb.Vertical(*causes),
                right if predicted else about,
                column_shares=[4, 3, 3],
            )
        )


def _channels(kind: SignalKind, scenario: Scenario, units: Mapping[str, str]) -> list[Channel]:
    """The signals of a kind as they are drawn; a unit not known is left empty."""
    colors = cycle(SERIES[2:] if kind.name == "actions" else SERIES)
    return [
        Channel(
            f"{kind.group}/{escaped(name)}" if kind.group in ALONE else str(kind.group),
            name,
            unit,
            SERIES[1] if name in ("penalty", "feedback_time") else next(colors),
            scenario.limits.get(name, FREE) if kind.vector else FREE,
            step=kind.name in HELD,
            tail=0.05 if kind.clock else 0.0,
        )
        for name, unit in kind.units(scenario, units).items()
    ]


def _about(scenario: Scenario, properties: Mapping[str, object]) -> str:
    return f"""# {scenario.name}

{scenario.description}

{_table("run", properties)}

**Time** is the plant's. Sample k of a state is what the controller measured; the input,
disturbance and cost of sample k hold until sample k+1. The cost per sample is economic cost +
penalty of violating the state bounds (red lines).

**Predictions**: line +i is the QP's prediction, made at the cursor, of the sample i later.
"""


def spare_pandas() -> None:
    """Let pyarrow go without pandas in this process, unless something has imported it.

    pyarrow would import it, 46 MB and an eighth of a second, to see that a list is no series.
    """

    class Missing:
        @staticmethod
        def find_spec(name: str, *_: object) -> None:
            if name == "pandas":
                raise ModuleNotFoundError(name)

    if "pandas" not in sys.modules:
        sys.meta_path.insert(0, Missing)
        pyarrow.array([0.0])  # pyarrow looks once
        sys.meta_path.remove(Missing)


def record_overlay(path: str | Path, runs: Mapping[str, RunSignals], about: str) -> None:
    """Write a recording of runs of one scenario by name, over each other; errors as of a run's.

    The signals are `<run>/<signal>` for every signal that all runs have, and, of two runs,
    `difference/<signal>`; bounds are those that the first run knows. `about` is Markdown.
    """
    from cosim.figures.style import lit, palette  # noqa: PLC0415 - matplotlib: a third of a second

    first, *others = runs.values()
    times_of = {
        name: run.signals["time"].values if "time" in run.signals else np.arange(float(len(run)))
        for name, run in runs.items()
    }
    rows = {name: times(np.arange(len(time)), time) for name, time in times_of.items()}
    colors = {name: lit(look.color) for name, look in palette(list(runs)).items()}
    seconds = max((float(time[-1]) for time in times_of.values() if len(time)), default=0.0)
    along = axis(AT(seconds=0.0), AT(seconds=seconds))
    ends = times([0, max(map(len, runs.values())) - 1], np.array([0.0, seconds]))
    title, overlaid, differences = " / ".join(runs), [], []
    with Stream(path, title, about) as stream:
        for signal, own in first.signals.items():
            if signal == "time" or not all(signal in run.signals for run in others):
                continue
            lines = []
            for name, run in runs.items():
                entity, bounds = f"{escaped(name)}/{escaped(signal)}", FREE
                if run is first:
                    bounds = first.bounds.get(signal, FREE)
                line = Channel(entity, f"{name}/{signal}", own.unit, colors[name], bounds, [name])
                stream.send([line], rows[name], run.signals[signal].values, ends)
                lines.append(line)
            overlaid.append(view(replace(lines[0], name=signal).title, lines, along))
            if len(runs) == 2:
                a, b = (run.signals[signal].values for run in runs.values())
                common = min(len(a), len(b))
                with np.errstate(invalid="ignore"):
                    values = a[:common] - b[:common]
                entity, name = f"difference/{escaped(signal)}", f"difference/{signal}"
                line = Channel(entity, name, own.unit, SERIES[3])
                time = next(iter(times_of.values()))[:common]
                stream.send([line], times(np.arange(common), time), values)
                differences.append(view(line.title, [line], along))
        stream.layout = _tabs({title: overlaid, "difference": differences})


def _tabs(tabs: Mapping[str, Sequence[rrb.View]], timeline: str = TIME) -> rrb.Blueprint:
    grids = [rrb.Grid(*views, grid_columns=3, name=name) for name, views in tabs.items() if views]
    page = rrb.TextDocumentView(name="about", origin="/about")
    return layout(rrb.Tabs(*grids, page), timeline)


def record_training(path: str | Path, training: Training) -> None:
    """Write a recording of a training: the signals are the log's columns and `increment/<block>`.

    `increment/<block>` is the change of a block of θ since the start, (K, size).

    Raises OSError where the file cannot be begun, RecordingError where it is not written whole.
    """
    run, blocks, log = training.run, training.parameters.blocks, training.log()
    properties = {
        "algorithm": run.algorithm,
        "scenario": run.scenario.name,
        "scenario_hash": run.scenario.hash,
        "samples": run.samples,
        "seed": run.seed,
        **run.configuration.model_dump(mode="json"),
    }
    samples = log["samples"].astype(np.int64)
    rows, theta, course = times(samples), [], []
    along = axis(AT(seq=0), AT(seq=int(samples[-1]) if len(samples) else 0))
    title = f"{run.algorithm} on {run.scenario.name}"
    about = f"# {title}\n\n{_table('training', properties)}"
    with Stream(path, title, about, properties) as stream:
        for name, values in training.theta().items():
            labels = list(blocks.labels[blocks.slices[name]])
            block = Channel(f"increment/{escaped(name)}", f"increment/{name}", labels=labels)
            stream.send([block], rows, values)
            theta.append(view(f"change of {name}", [block], along))
        for (name, values), color in zip(log.items(), cycle(SERIES), strict=False):
            rare = bool(np.isnan(values).any())
            column = Channel(f"log/{escaped(name)}", name, color=color, points=rare)
            stream.send([column], rows, values)
            course.append(view(name, [column], along))
        stream.layout = _tabs({"θ": theta, "log": course}, SAMPLE)


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
    bounds: Range = FREE
    labels: Sequence[str] = ()
    step: bool = False
    points: bool = False
    tail: float = 0.0
    seen: Range = (inf, -inf)

    @property
    def title(self) -> str:
        """Name, unit and bounds in words: the viewer's font has no ≥."""
        label = self.name if self.unit in ("", "1") else f"{self.name} [{self.unit}]"
        sides = zip(("at least", "at most"), self.bounds, strict=True)
        return ", ".join([label, *(f"{side} {b:g}" for side, b in sides if isfinite(b))])

    def see(self, values: Array) -> None:
        """Widen the range seen by values of any shape."""
        values = values[np.isfinite(values)]
        if values.size:
            low, high = self.seen
            top = np.quantile(values, 1.0 - self.tail) if self.tail else values.max()
            self.seen = (min(low, float(values.min())), max(high, float(top)))

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
        self.path, self.layout = check_target(path), layout
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
        """Send K rows of the signals of one entity: (K,), (K, m), or (K, labels).

        Finite bounds are drawn between two times `ends`.
        """
        entity = channels[0].entity
        for channel, column in zip(
            channels, values.T if len(channels) > 1 else [values], strict=True
        ):
            channel.see(column)
            for side, bound in zip(("lower", "upper"), channel.bounds, strict=True):
                if ends and isfinite(bound):
                    line = Channel(f"bounds/{channel.entity}/{side}", f"{side} bound", color=BOUND)
                    self.rerun.log(line.entity, _style([line]), static=True)
                    drawn = rr.Scalars.columns(scalars=[bound, bound])
                    self.rerun.send_columns(line.entity, ends, drawn)
        if entity not in self._declared:
            self._declared.add(entity)
            names, units = [c.name for c in channels], [c.unit for c in channels]
            mark = rr.DynamicArchetype(SIGNAL, components={"name": names, "unit": units})
            self.rerun.log(entity, mark, _style(channels), static=True)
        self.rerun.send_columns(entity, times, rr.Scalars.columns(scalars=np.array(values)))

    def close(self) -> None:
        """Finish the file, with the layout, and give it its name.

        Raises RecordingError where not all of it could be written.
        """
        if self.rerun in _ABANDONED:
            return
        if self.layout is not None:
            self.rerun.send_blueprint(self.layout)
        self._bounded(self.rerun.disconnect)
        with self._partial.open("rb") as written:
            written.seek(-min(len(_FOOTER) + 32, self._partial.stat().st_size), os.SEEK_END)
            if _FOOTER not in written.read():
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
    """Replace by `?` each character that the viewer's font lacks: the headless viewer aborts."""
    return "".join(
        c if c == "\n" or any(low <= ord(c) <= high for low, high in _DRAWABLE) else "?"
        for c in text
    )


def times(samples: Sequence[int] | np.ndarray, time: Array | None = None) -> list[rr.TimeColumn]:
    """Index columns of K rows: sample numbers and, where there is one, the time in s to 1 ns."""
    columns = [rr.TimeColumn(SAMPLE, sequence=np.asarray(samples, dtype=np.int64))]
    if time is not None:
        nanoseconds = np.rint(time * 1e9).astype("timedelta64[ns]")
        columns.append(rr.TimeColumn(TIME, duration=nanoseconds))
    return columns


def axis(start: rr.TimeRangeBoundary, end: rr.TimeRangeBoundary) -> rrb.TimeAxis:
    """Horizontal axis over a whole run."""
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


def layout(root: rrb.Container, timeline: str = TIME) -> rrb.Blueprint:
    """The views with a paused time panel on a timeline, and no other panels in the way."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused"),
    )


def _table(title: str, values: Mapping[str, object]) -> str:
    rows = [(key.replace("_", " "), str(value)) for key, value in values.items()]
    return markdown_table((title, ""), rows)
