"""Records training: θ by block, TD error, definiteness, cost, and the policy over the states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, nan
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cosim.protocols import Controller
from cosim.recording.blueprint import framed, sample_axis, series, union
from cosim.recording.channels import Channel, escaped
from cosim.recording.glyphs import drawable
from cosim.recording.palette import SERIES, packed, packed_all
from cosim.recording.policy_map import PolicyMap
from cosim.recording.stream import SAMPLE, Stream, line, mark
from cosim.scenario import Scenario
from cosim.statistics import TD_WINDOW, td_error_mean

Array = NDArray[np.float64]
FIRST_ROWS, ROWS = 16, 256
"""Rows that are sent together: Rerun keeps about 2 kB in memory of what is sent to an entity.

The first ones come sooner, so that a training that is killed has left a layout.
"""
_TOGETHER = {
    "cost per sample": ("J", "greedy_J", "reference_J"),
    "heat transfer": ("UA2",),
    "TD error": ("td_error", "td_error_mean"),
    "smallest eigenvalue": ("smallest_eigenvalue",),
    "violating share": ("greedy_violating_share",),
}


class Parameters(Protocol):
    """θ with its layout; `controllers.parameters.Parameters` is one."""

    @property
    def theta(self) -> Array:
        """Flat vector, (n_θ,)."""

    @property
    def blocks(self) -> Any:
        """Its `slices` give each block's place in θ, its `labels` a name for each entry."""

    @property
    def hash(self) -> str:
        """Hash of layout and values."""


class TrainingRun(Protocol):
    """What is trained; `learning.training_run.TrainingRun` is one."""

    @property
    def algorithm(self) -> str:
        """Name of the algorithm."""

    @property
    def scenario(self) -> Scenario:
        """Scenario trained on."""

    @property
    def samples(self) -> int:
        """Budget in samples."""

    @property
    def seed(self) -> int:
        """Seed of disturbances and exploration."""

    @property
    def configuration(self) -> Any:
        """Pydantic model of the hyperparameters."""


class TrainingRecorder:
    """A `.rrd` file of a training run; the training loop hands it the rows of its log.

    Signals: `theta/<block>`, each column of the log, `td_error_mean` (root mean square over the
    preceding 10 000 samples, the average of paper.tex, fig. nmpc_learn), and, where a row has a
    greedy evaluation, `policy/<input>` and `policy/value` on a grid of the first two states.

    Raises
    ------
    RecordingError : the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stream: Stream | None = None

    def start(self, run: TrainingRun, parameters: Parameters) -> None:
        """Open the file; the plots of θ count from these parameters."""
        self._samples, self._start = run.samples, parameters.theta.copy()
        self._slices = parameters.blocks.slices
        self._blocks = {name: Channel("theta", name, "", SERIES[0]) for name in self._slices}
        self._scalars: dict[str, Channel] = {}
        self._rows: list[Mapping[str, float]] = []
        self._thetas: list[Array] = []
        self._recent: list[tuple[float, float, float]] = []
        self._map: PolicyMap | None = None
        scenario, name = run.scenario, f"{run.algorithm} on {run.scenario.name}"
        stream = self._stream = Stream(self.path, name)
        properties = {
            "algorithm": run.algorithm,
            "scenario": scenario.name,
            "scenario_hash": scenario.hash,
            "seed": run.seed,
            "samples": run.samples,
            "theta_hash": parameters.hash,
            **run.configuration.model_dump(mode="json"),
        }
        stream.properties("run", properties)
        facts = "\n".join(f"| {key.replace('_', ' ')} | {v} |" for key, v in properties.items())
        text = f"# {name}\n\n{scenario.description}\n\n| training | |\n|---|---|\n{facts}\n"
        document = rr.TextDocument(drawable(text), media_type=rr.MediaType.MARKDOWN)
        stream.static("about", document)
        if len(scenario.plant.states) >= 2 and len(scenario.plant.actions) >= 2:
            self._map = PolicyMap(stream, scenario)
        for block, entries in self._slices.items():
            _declare_block(stream, block, parameters.blocks.labels[entries])

    def record(
        self, row: Mapping[str, float], parameters: Parameters, controller: Controller
    ) -> None:
        """Append a row of the log, with θ after it and a controller that has this θ."""
        if self._stream is None:
            raise RuntimeError("TrainingRecorder.start must come first, and close last")
        self._rows.append({**row, "td_error_mean": self._td_error_mean(row)})
        self._thetas.append(parameters.theta.copy())
        if self._map is not None and isfinite(row.get("greedy_J", nan)):
            self._map.send(int(row["samples"]), controller)
        if len(self._rows) >= (ROWS if self._stream.begun else FIRST_ROWS):
            self._send()

    def close(self) -> None:
        """Send the rest, the layout again if the training has outgrown it, and name the file."""
        if self._stream is not None:
            self._send()
            channels = [*self._blocks.values(), *self._scalars.values()]
            if self._stream.outgrown(channels):
                self._stream.layout(self._blueprint(), channels)
            self._stream.close()
            self._stream = None

    def _td_error_mean(self, row: Mapping[str, float]) -> float:
        """Root mean square TD error of the preceding 10 000 samples, as every table has it."""
        number = row["samples"]
        self._recent.append((number, row.get("td_error", nan), row.get("updates", nan)))
        # The row before the window says where the first one within it begins.
        self._recent = [entry for entry in self._recent if entry[0] >= number - TD_WINDOW]
        return float(td_error_mean(*np.array(self._recent).T)[-1])

    def _send(self) -> None:
        if self._stream is None or not self._rows:
            return
        stream, rows, theta = self._stream, self._rows, np.array(self._thetas)
        times = [rr.TimeColumn(SAMPLE, sequence=[int(row["samples"]) for row in rows])]
        for name, entries in self._slices.items():
            increments = (theta - self._start)[:, entries]
            stream.scalars(f"theta/{escaped(name)}", times, theta[:, entries])
            stream.scalars(f"increment/{escaped(name)}", times, increments)
            self._blocks[name] = self._blocks[name].with_values(increments)
        for name in rows[0]:
            values = np.array([row[name] for row in rows], dtype=np.float64)
            if name not in self._scalars:
                color = SERIES[len(self._scalars) % len(SERIES)]
                channel = self._scalars[name] = Channel("log", name, "", color)
                style = _style(name, color, sparse=bool(np.isnan(values).any()))
                stream.static(channel.entity, mark([name], [""]), style)
            self._scalars[name] = self._scalars[name].with_values(values)
            stream.scalars(self._scalars[name].entity, times, values)
        if not stream.begun:
            stream.layout(self._blueprint(), [*self._blocks.values(), *self._scalars.values()])
        self._rows, self._thetas = [], []

    def _blueprint(self) -> rrb.Blueprint:
        axis = sample_axis(self._samples)
        increments = [
            series(f"increment of {name}", [f"/increment/{escaped(name)}"], axis, c.window())
            for name, c in self._blocks.items()
        ]
        grouped = {
            title: [self._scalars[name] for name in names if name in self._scalars]
            for title, names in _TOGETHER.items()
        }
        shown = {channel.name for channels in grouped.values() for channel in channels}
        others = [[channel] for name, channel in self._scalars.items() if name not in shown]
        figures = [_view(title, channels, axis) for title, channels in grouped.items() if channels]
        rest = [_view(channels[0].name, channels, axis) for channels in others]
        about = rrb.TextDocumentView(name="about this training", origin="/about")
        more = rrb.Tabs(about, *([rrb.Grid(*rest, name="the rest of the log")] if rest else []))
        right = [more] if self._map is None else [self._map.view(), more]
        columns = [
            rrb.Grid(*increments, grid_columns=2),
            *([rrb.Vertical(*figures)] if figures else []),
            rrb.Vertical(*right),
        ]
        return framed(rrb.Horizontal(*columns), SAMPLE)


def _declare_block(stream: Stream, block: str, labels: Sequence[str]) -> None:
    stream.static(f"theta/{escaped(block)}", mark([f"theta/{block}"], [""]))
    stream.static(
        f"increment/{escaped(block)}",
        rr.SeriesLines(
            names=[drawable(label) for label in labels],
            colors=packed_all([SERIES[i % len(SERIES)] for i in range(len(labels))]),
            widths=np.full(len(labels), 1.5),
        ),
    )


def _style(name: str, color: str, *, sparse: bool) -> rr.SeriesLines | rr.SeriesPoints:
    """A line, or points for what is measured now and then: a line breaks at every NaN."""
    label = name.replace("_", " ")
    if sparse:
        return rr.SeriesPoints(names=label, colors=packed(color), marker_sizes=4.0)
    return line(label, color)


def _view(title: str, channels: Sequence[Channel], axis: rrb.TimeAxis) -> rrb.TimeSeriesView:
    entities = [f"/{channel.entity}" for channel in channels]
    return series(
        title.replace("_", " "), entities, axis, union(channels), legend=len(channels) > 1
    )
