"""Records a closed-loop run; the loop hands it blocks of samples."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from itertools import cycle
from math import inf
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cosim.protocols import Controller, SampleBlock, controller_name
from cosim.recording.stream import (
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
