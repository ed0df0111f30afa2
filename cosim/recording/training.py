"""Records training: θ by block, TD error, definiteness, cost, and the policy over the states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cosim.recording.channels import Channel, escaped
from cosim.recording.layout import framed, sample_axis, series, union
from cosim.recording.palette import SERIES, packed_all
from cosim.recording.policy_map import ENTITY as POLICY
from cosim.recording.policy_map import PolicyMap
from cosim.recording.stream import SAMPLE, UPDATE, Stream, line, mark
from cosim.recording.text import drawable
from cosim.scenario import Scenario

Array = NDArray[np.float64]
_TOGETHER = ("td_error", "td_error_mean")


class TrainingRecorder:
    """A `.rrd` file of a training run; the training loop hands it blocks of updates.

    Raises
    ------
    RecordingError : the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._stream: Stream | None = None

    def start(
        self,
        scenario: Scenario,
        algorithm: str,
        blocks: Mapping[str, Sequence[str]],
        theta: Array,
        samples: int,
        properties: Mapping[str, object],
    ) -> None:
        """Open the file.

        `blocks` names the blocks of θ in order and the entries of each; `theta` (n_θ,) is θ₀, from
        which the plots count; `samples` is the budget; `properties` (seed, hashes, settings) are
        shown as they are.
        """
        self._scenario, self._samples = scenario, samples
        self._start = np.array(theta)
        ends = np.cumsum([len(entries) for entries in blocks.values()])
        self._slices = {
            name: slice(int(end) - len(entries), int(end))
            for (name, entries), end in zip(blocks.items(), ends, strict=True)
        }
        self._blocks = {name: Channel("theta", name, "", SERIES[0]) for name in blocks}
        self._scalars: dict[str, Channel] = {}
        self._map: PolicyMap | None = None
        name = f"{algorithm} on {scenario.name}"
        stream = self._stream = Stream(self.path, self._blueprint(), name)
        described: dict[str, object] = {
            "algorithm": algorithm,
            "scenario": scenario.name,
            "scenario_hash": scenario.hash,
            **properties,
        }
        stream.properties("run", described)
        facts = "\n".join(f"| {key.replace('_', ' ')} | {v} |" for key, v in described.items())
        text = f"# {name}\n\n{scenario.description}\n\n| training | |\n|---|---|\n{facts}\n"
        document = rr.TextDocument(drawable(text), media_type=rr.MediaType.MARKDOWN)
        stream.static("about", document)
        for block, entries in blocks.items():
            stream.static(f"theta/{escaped(block)}", mark(f"theta/{block}", ""))
            colors = packed_all([SERIES[i % len(SERIES)] for i in range(len(entries))])
            names = [drawable(entry) for entry in entries]
            stream.static(
                f"increment/{escaped(block)}",
                rr.SeriesLines(names=names, colors=colors, widths=np.full(len(entries), 1.5)),
            )

    def record(
        self,
        updates: NDArray[np.int64],
        samples: NDArray[np.int64],
        theta: Array,
        scalars: Mapping[str, Array],
    ) -> None:
        """Append K updates: their numbers, the samples seen so far, θ (K, n_θ) after each.

        `scalars` are further columns (K,) by name, NaN where an update has none: `td_error`,
        `td_error_mean`, `smallest_eigenvalue`, `J`, ….
        """
        stream = self._open
        times = [
            rr.TimeColumn(SAMPLE, sequence=samples),
            rr.TimeColumn(UPDATE, sequence=updates),
        ]
        for name, entries in self._slices.items():
            values, increments = theta[:, entries], (theta - self._start)[:, entries]
            stream.scalars(f"theta/{escaped(name)}", times, values)
            stream.scalars(f"increment/{escaped(name)}", times, increments)
            self._blocks[name] = self._blocks[name].with_values(increments)
        for name, values in scalars.items():
            if name not in self._scalars:
                color = SERIES[len(self._scalars) % len(SERIES)]
                channel = self._scalars[name] = Channel("scalars", name, "", color)
                stream.static(channel.entity, mark(name, ""), line(name.replace("_", " "), color))
            self._scalars[name] = self._scalars[name].with_values(values)
            stream.scalars(self._scalars[name].entity, times, values)

    def record_policy(
        self, update: int, sample: int, x: Array, y: Array, actions: Array, values: Array
    ) -> None:
        """Append the policy (ny, nx, 2) and value (ny, nx) on a grid of the first two states.

        The grid x (nx,), y (ny,) must be the same in every call.
        """
        if self._map is None:
            self._map = PolicyMap(self._open, self._scenario, x, y)
        self._map.send(update, sample, actions, values)

    def close(self) -> None:
        """Send the layout with the ranges that were needed, and give the file its name."""
        if self._stream is not None:
            self._stream.blueprint(self._blueprint())
            self._stream.close()
            self._stream = None

    @property
    def _open(self) -> Stream:
        if self._stream is None:
            raise RuntimeError("TrainingRecorder.start must come first, and close last")
        return self._stream

    def _blueprint(self) -> rrb.Blueprint:
        axis = sample_axis(self._samples)
        theta = rrb.Grid(
            *(
                series(f"increment of {name}", [f"/increment/{escaped(name)}"], axis, c.window())
                for name, c in self._blocks.items()
            ),
            grid_columns=2,
        )
        together = [self._scalars[name] for name in _TOGETHER if name in self._scalars]
        alone = [c for name, c in self._scalars.items() if name not in _TOGETHER]
        views: list[rrb.View] = []
        if together:
            entities = [f"/{channel.entity}" for channel in together]
            views.append(series("TD error", entities, axis, union(together), legend=True))
        for channel in alone:
            name = channel.name.replace("_", " ")
            views.append(series(name, [f"/{channel.entity}"], axis, channel.window()))
        about = rrb.TextDocumentView(name="about this training", origin="/about")
        right: list[rrb.View] = [about]
        if self._map is not None:
            x_range, y_range = self._map.bounds
            bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
            origin = f"/{POLICY}/map"
            right.insert(
                0, rrb.Spatial2DView(name="policy and value", origin=origin, visual_bounds=bounds)
            )
        columns = [theta, *([rrb.Vertical(*views)] if views else []), rrb.Vertical(*right)]
        return framed(rrb.Horizontal(*columns), SAMPLE)
