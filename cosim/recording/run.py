"""Records a run by blocks of samples; ended runs, over each other; a training, by its samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from itertools import chain, cycle
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cosim.comparison import RunSignals
from cosim.protocols import Array, Controller, SampleBlock
from cosim.recording.stream import (
    SAMPLE,
    SERIES,
    TIME,
    Channel,
    Stream,
    about_view,
    axis,
    drawable,
    escaped,
    layout,
    packed_color,
    table,
    times,
    view,
)
from cosim.scenario import Scenario
from cosim.simulation import controller_name
from cosim.trajectory import SIGNALS, SignalKind

ALONE = ("states", "actions", "costs")
"""Groups with an entity for each signal; those of the others share one, which takes less space."""
HELD = ("actions", "disturbances")
FREE = (-inf, inf)
_STATUS, _RESIDUAL = "solver/status", "solver/log_residual"
_GOOD = "#3A9A5B"


class RerunRecorder:
    """Recorder of `simulate`: a `.rrd` file with layout, signals, predictions and run properties.

    Every signal keeps its name and float64 bits; `read_recording` gives them back. Predictions are
    the signals `prediction/<name>`, N+1 or N numbers a sample.

    Raises RecordingError where the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stream: Stream | None = None

    def start(
        self,
        scenario: Scenario,
        controller: Controller,
        seed: int,
        steps: int,
        units: dict[str, str],
    ) -> None:
        """Open the file and write what is known before the first sample."""
        name = controller_name(controller)
        self._seconds = steps * scenario.sampling_time
        recorded = [kind for kind in SIGNALS if kind.group is not None]
        self._kinds = {kind: _channels(kind, scenario, units) for kind in recorded}
        self._predicted: dict[str, Channel] = {}
        self._residual = Channel(_RESIDUAL, "log10 of the KKT residual", color=SERIES[2])
        self._status: str | None = None
        self._samples = 0
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
        stream = self._stream = Stream(self.path, title, self._layout())
        stream.properties(properties)
        stream.about(_about(scenario, properties))
        good = rr.StateConfiguration(values=["solved"], colors=[packed_color(_GOOD)])
        stream.static(_STATUS, good)

    def record(self, block: SampleBlock) -> None:
        """Append K samples: one column of K rows for each signal."""
        stream = self._stream
        if stream is None or not len(block):
            return
        samples, time = np.arange(block.first, block.first + len(block)), block["time"]
        rows, ends = times(samples, time), times(samples[[0, -1]], time[[0, -1]])
        bundles: dict[str, tuple[list[Channel], list[np.ndarray]]] = {}
        for kind, channels in self._kinds.items():
            for channel, values in zip(
                channels, block[kind.name].reshape(len(block), -1).T, strict=True
            ):
                channel.see(values, tail=0.05 if kind.clock else 0.0)
                members, columns = bundles.setdefault(channel.entity, ([], []))
                members.append(channel)
                columns.append(values)
            stream.bounds(channels, ends)
        for members, columns in bundles.values():
            stream.send(members, rows, np.column_stack(columns))
        with np.errstate(divide="ignore", invalid="ignore"):
            residual = np.log10(block["residual"])
        stream.columns(_RESIDUAL, rows, rr.Scalars.columns(scalars=residual))
        self._residual.see(residual)
        self._changes_of_status(stream, samples, block)
        self._predictions(stream, rows, block)
        self._samples += len(block)

    def close(self) -> None:
        """Finish the file with the ranges that the run has filled; no sample, no file."""
        if self._stream is not None:
            if self._samples:
                self._stream.close(self._layout())
            else:
                self._stream.discard()
            self._stream = None

    def _changes_of_status(self, stream: Stream, samples: np.ndarray, block: SampleBlock) -> None:
        before = [self._status, *block.status[:-1]]
        rows = [i for i, status in enumerate(block.status) if status != before[i]]
        self._status = block.status[-1]
        if rows:
            states = rr.StateChange.columns(state=[drawable(block.status[i]) for i in rows])
            stream.columns(_STATUS, times(samples[rows], block["time"][rows]), states)

    def _predictions(self, stream: Stream, rows: list[rr.TimeColumn], block: SampleBlock) -> None:
        for group, values in (
            ("states", block.predicted_states),
            ("actions", block.predicted_actions),
        ):
            if values is None:
                continue
            for i, channel in enumerate(self._group(group)):
                predicted = self._predicted.setdefault(
                    channel.name,
                    Channel(
                        f"prediction/{escaped(channel.name)}",
                        f"prediction/{channel.name}",
                        channel.unit,
                        labels=[f"+{stage}" for stage in range(values.shape[1])],
                    ),
                )
                predicted.see(values[:, :, i])
                stream.send([predicted], rows, values[:, :, i])

    def _group(self, *groups: str) -> list[Channel]:
        return [
            c for kind, channels in self._kinds.items() if kind.group in groups for c in channels
        ]

    def _layout(self) -> rrb.Blueprint:
        """Left: states and actions with bounds; middle: costs, causes, solver; right: the rest."""
        along = axis(seconds=self._seconds)
        loop = [view(c.title, [c], along) for c in self._group("states", "actions")]
        causes = [
            *(view(c.title, [c], along) for c in self._group("costs")),
            view("disturbances", self._group("disturbances"), along),
            view("prepare and feedback time [s]", self._group("step_time"), along),
            view(self._residual.name, [self._residual], along),
            rrb.StateTimelineView(name="QP status", contents=[f"/{_STATUS}"], time_view=along),
        ]
        about = about_view("about this run")
        predicted = [view(c.title, [c], along, legend=False) for c in self._predicted.values()]
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
        )
        for name, unit in zip(kind.names(scenario), kind.units(scenario, units), strict=True)
    ]


def _about(scenario: Scenario, properties: Mapping[str, object]) -> str:
    return f"""# {scenario.name}

{scenario.description}

{table("run", properties)}

**Time** is the plant's. Sample k of a state is what the controller measured; the input,
disturbance and cost of sample k hold until sample k+1. The cost per sample is economic cost +
penalty of violating the state bounds (red lines).

**Predictions**: line +i is the QP's prediction, made at the cursor, of the sample i later.
"""


class Plot(NamedTuple):
    """A view of what has ended: its title, and of each signal its channel, rows and values."""

    title: str
    signals: Sequence[tuple[Channel, list[rr.TimeColumn], Array]]


def _record(
    path: str | Path,
    title: str,
    tabs: Mapping[str, Sequence[Plot]],
    along: rrb.TimeAxis,
    about: str,
    *,
    timeline: str = TIME,
    ends: list[rr.TimeColumn] | None = None,
    properties: Mapping[str, object] = MappingProxyType({}),
) -> None:
    """Write a recording of plots in tabs; bounds are drawn between the two times `ends`."""
    grids = []
    for name, plots in tabs.items():
        views = (view(p.title, [channel for channel, _, _ in p.signals], along) for p in plots)
        grids += [rrb.Grid(*views, grid_columns=3, name=name)] * bool(plots)
    shown = layout(rrb.Tabs(*grids, about_view("about")), timeline)
    with Stream(path, title, shown) as stream:
        if properties:
            stream.properties(properties)
        stream.about(about)
        for plot in chain(*tabs.values()):
            for channel, rows, values in plot.signals:
                stream.bounds([channel], ends or [])
                stream.send([channel], rows, values)


def record_overlay(path: str | Path, runs: Mapping[str, RunSignals], about: str) -> None:
    """Write a recording of runs of one scenario by name, over each other; raises RecordingError.

    The signals are `<run>/<signal>` for every signal that all runs have, and, of two runs,
    `difference/<signal>`; bounds are those that the first run knows. `about` is Markdown.
    """
    first, *others = runs.values()
    times_of = {
        name: run.signals["time"].values if "time" in run.signals else np.arange(float(len(run)))
        for name, run in runs.items()
    }
    rows = {name: times(np.arange(len(time)), time) for name, time in times_of.items()}
    overlaid, differences = [], []
    for signal, own in first.signals.items():
        if signal == "time" or not all(signal in run.signals for run in others):
            continue
        lines = []
        for (name, run), color in zip(runs.items(), cycle(SERIES), strict=False):
            entity, values = f"{escaped(name)}/{escaped(signal)}", run.signals[signal].values
            bounds = first.bounds.get(signal, FREE) if run is first else FREE
            line = Channel(entity, f"{name}/{signal}", own.unit, color, bounds, labels=[name])
            lines.append((line.see(values), rows[name], values))
        overlaid.append(Plot(replace(lines[0][0], name=signal).title, lines))
        if len(runs) == 2:
            common = min(len(values) for _, _, values in lines)
            with np.errstate(invalid="ignore"):
                values = lines[0][2][:common] - lines[1][2][:common]
            entity, name = f"difference/{escaped(signal)}", f"difference/{signal}"
            line = Channel(entity, name, own.unit, SERIES[3]).see(values)
            time = next(iter(times_of.values()))[:common]
            differences.append(Plot(line.title, [(line, times(np.arange(common), time), values)]))
    seconds = max((float(time[-1]) for time in times_of.values() if len(time)), default=0.0)
    title, last = " / ".join(runs), max(map(len, runs.values())) - 1
    tabs = {title: overlaid, "difference": differences}
    ends = times([0, last], np.array([0.0, seconds]))
    _record(path, title, tabs, axis(seconds=seconds), about, ends=ends)


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
    samples = log["samples"].astype(np.int64)
    rows, theta, course = times(samples), [], []
    for name, values in increments.items():
        entity, own = f"increment/{escaped(name)}", list(labels[name])
        block = Channel(entity, f"increment/{name}", labels=own).see(values)
        theta.append(Plot(f"change of {name}", [(block, rows, values)]))
    for (name, values), color in zip(log.items(), cycle(SERIES), strict=False):
        rare = bool(np.isnan(values).any())
        column = Channel(f"log/{escaped(name)}", name, color=color, points=rare).see(values)
        course.append(Plot(name, [(column, rows, values)]))
    along = axis(samples=int(samples[-1]) if len(samples) else 0)
    about = f"# {title}\n\n{table('training', properties)}\n"
    tabs = {"θ": theta, "log": course}
    _record(path, title, tabs, along, about, timeline=SAMPLE, properties=properties)
