"""Records a run by blocks of samples; ended runs, over each other; a training, by its samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from itertools import cycle
from math import inf
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cosim.comparison import RunSignals
from cosim.protocols import Array, Controller, SampleBlock, controller_name
from cosim.recording.stream import (
    SAMPLE,
    SERIES,
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
from cosim.trajectory import SIGNALS, SignalKind

ALONE = ("states", "actions", "costs")
"""Groups with an entity for each signal; those of the others share one, which takes less space."""
HELD = ("actions", "disturbances")
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
            scenario.limits.get(name, (-inf, inf)) if kind.vector else (-inf, inf),
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
