"""Records a closed-loop run; the loop hands it blocks of samples."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from importlib.metadata import version
from pathlib import Path

import numpy as np
import rerun as rr

from cosim.protocols import Controller, SampleBlock, controller_name
from cosim.recording import diagram
from cosim.recording.blocks import joined
from cosim.recording.blueprint import run_blueprint
from cosim.recording.channels import Channel, run_channels, run_columns
from cosim.recording.description import describe
from cosim.recording.glyphs import drawable
from cosim.recording.horizon import Horizon, Strip
from cosim.recording.palette import BOUND, GOOD, SERIES, packed
from cosim.recording.stream import Stream, line, lines, mark, sample_times
from cosim.scenario import Scenario

ROWS = 4096


class RerunRecorder:
    """Recorder of `simulate`: a `.rrd` file with layout, signals, predictions and run properties.

    Every signal keeps its name and float64 bits; `read_signals` gives them back.

    Raises
    ------
    RecordingError : the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stream: Stream | None = None
        self._pending: list[SampleBlock] = []

    def start(
        self,
        scenario: Scenario,
        controller: Controller,
        seed: int,
        steps: int,
        units: dict[str, str],
    ) -> None:
        """Open the file and say what is known before the first sample."""
        name = controller_name(controller)
        theta = str(getattr(getattr(controller, "parameters", None), "hash", "none"))
        self._duration = steps * scenario.sampling_time
        self._channels = run_channels(scenario, units)
        self._horizon: Horizon | None = None
        self._status: str | None = None
        stream = Stream(self.path, f"{name} on {scenario.name}, seed {seed}")
        properties = {
            "scenario": scenario.name,
            "scenario_hash": scenario.hash,
            "controller": name,
            "theta_hash": theta,
            "seed": seed,
            "steps": steps,
            "sampling_time": f"{scenario.sampling_time:g} s",
            "fmu": Path(scenario.plant.fmu).name,
            "package": f"rti-cosim {version('rti-cosim')}",
        }
        stream.properties("run", properties)
        text = describe(scenario, properties, self._channels)
        stream.static("about", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        diagram.draw(stream, scenario, name, theta)
        self._declare(stream)
        self._stream = stream

    def record(self, block: SampleBlock) -> None:
        """Append K samples; they reach the file when `ROWS` have come together."""
        self._pending.append(deepcopy(block))
        if sum(map(len, self._pending)) >= ROWS:
            self._send()

    def close(self) -> None:
        """Send the rest, the layout again if the run has outgrown it, and name the file."""
        if self._stream is not None:
            self._send()
            if self._stream.outgrown(self._in_view()):
                self._lay_out(self._stream)
            self._stream.close()
            self._stream = None

    def _send(self) -> None:
        """Send what is pending: one column of K rows for each signal."""
        if self._stream is None or not self._pending:
            return
        stream, block = self._stream, joined(self._pending)
        self._pending.clear()
        samples = np.arange(block.first, block.first + len(block))
        times = sample_times(samples, block["time"])
        ends = sample_times(samples[[0, -1]], block["time"][[0, -1]])
        columns = run_columns(block)
        for i, values in enumerate(columns):
            self._channels[i] = self._channels[i].with_values(values)
        for entity, rows in self._entities().items():
            values = np.column_stack([columns[i] for i in rows])
            stream.scalars(entity, times, values)
        for entity, bound in self._bounds():
            # Two rows a block are enough to draw a constant line.
            stream.scalars(entity, ends, np.full(2, bound))
        with np.errstate(divide="ignore", invalid="ignore"):
            stream.scalars("display/log_residual", times, np.log10(block["residual"]))
        self._changes_of_status(stream, samples, block)
        predicted = self._horizon is not None
        self._predictions(stream, times, block)
        if not stream.begun or predicted != (self._horizon is not None):
            self._lay_out(stream)

    def _lay_out(self, stream: Stream) -> None:
        predicts = self._horizon is not None
        blueprint = run_blueprint(self._duration, self._channels, predicts=predicts)
        stream.layout(blueprint, self._in_view())

    def _in_view(self) -> list[Channel]:
        return [channel for channel in self._channels if channel.group != "unseen"]

    def _entities(self) -> dict[str, list[int]]:
        """Channels of each entity, by their numbers."""
        entities: dict[str, list[int]] = {}
        for i, channel in enumerate(self._channels):
            entities.setdefault(channel.entity, []).append(i)
        return entities

    def _bounds(self) -> Iterator[tuple[str, float]]:
        """Entity and value of every finite bound."""
        for channel in self._channels:
            for side, bound in zip(("lower", "upper"), channel.bounds, strict=True):
                if np.isfinite(bound):
                    yield f"{channel.bound_entity}/{side}", bound

    def _declare(self, stream: Stream) -> None:
        for entity, rows in self._entities().items():
            channels = [self._channels[i] for i in rows]
            labels, colors = [c.label for c in channels], [c.color for c in channels]
            style = lines(labels, colors, step=channels[0].step)
            names, units = [c.name for c in channels], [c.unit for c in channels]
            stream.static(entity, mark(names, units), style)
        for entity, _ in self._bounds():
            stream.static(entity, line(entity.rpartition("/")[2], BOUND, width=2.0))
        stream.static("display/log_residual", line("log10 residual", SERIES[2]))
        stream.static(
            "solver/status", rr.StateConfiguration(values=["solved"], colors=[packed(GOOD)])
        )

    def _changes_of_status(self, stream: Stream, samples: np.ndarray, block: SampleBlock) -> None:
        before = [self._status, *block.status[:-1]]
        rows = [i for i, status in enumerate(block.status) if status != before[i]]
        self._status = block.status[-1]
        if rows:
            states = rr.StateChange.columns(state=[drawable(block.status[i]) for i in rows])
            stream.columns(
                "solver/status", sample_times(samples[rows], block["time"][rows]), states
            )

    def _predictions(self, stream: Stream, times: list[rr.TimeColumn], block: SampleBlock) -> None:
        states, actions = block.predicted_states, block.predicted_actions
        if states is None or actions is None:
            return
        strips: list[list[Strip]] = []
        for group, values in (("states", states), ("actions", actions)):
            channels = [channel for channel in self._channels if channel.group == group]
            if self._horizon is None:
                names = [f"prediction/{channel.name}" for channel in channels]
                stream.static(f"predicted/{group}", mark(names, [c.unit for c in channels]))
                seen = [c.with_values(values[:, :, i]) for i, c in enumerate(channels)]
                strips.append([_strip(channel) for channel in seen])
            rows = values.transpose(0, 2, 1).reshape(len(values), -1)
            stream.scalars(f"predicted/{group}", times, rows)
        if self._horizon is None:
            self._horizon = Horizon(stream, strips[0], strips[1], actions.shape[1])
        self._horizon.send(times, states, actions)


def _strip(channel: Channel) -> Strip:
    reference = np.nan if channel.reference is None else channel.reference
    return Strip(channel.label, channel.color, channel.window(), channel.bounds, reference)
