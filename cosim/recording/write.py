"""Records a run while it goes on, part by part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from itertools import chain, cycle
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun import escape_entity_path_part as escaped

from cosim.core.protocols import Array, Controller
from cosim.core.scenario import Scenario
from cosim.core.simulation import controller_name
from cosim.core.trajectory import SIGNALS, SignalKind
from cosim.recording.layout import AT, OPENING, axis, properties_table, tabs, view
from cosim.recording.stream import FREE, SERIES, Channel, Stream, drawable, packed_color, times

ALONE = ("states", "actions", "sensors", "costs")
"""Groups with an entity for each signal; those of the others share one, which takes less space."""
HELD = ("actions", "disturbances", "signals")
"""Kinds of signals whose values hold until the next sample."""
FIRST_COLORS = {"actions": 2, "measurements": 2, "estimates": 4}
"""Number in `SERIES` of the first colour of a kind; 0 of the others."""
SECOND_OF_A_VIEW = ("penalty", "feedback_time")
"""Signals in the second colour: they stand beside, or in one view with, one in the first."""
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
        # A controller that is no NMPC has no θ.
        parameters = getattr(controller, "parameters", None)
        self._seconds = steps * scenario.sampling_time
        self._make_channels(scenario, units)
        self._status: str | None = None
        # A forecast may have driven the plant already.
        self._within.clear()
        # The viewer shows them when the recording is selected.
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

    def _make_channels(self, scenario: Scenario, units: Mapping[str, str]) -> None:
        """Make the channels of all that a run of a scenario records."""
        self._kinds = {}
        for kind in SIGNALS:
            if kind.group is not None:
                self._kinds[kind] = _channels(kind, scenario, units)
        self._predicted = {}
        for group in ("states", "actions"):
            channels = [_predicted_channel(channel) for channel in self._group(group)]
            self._predicted[f"predicted_{group}"] = channels
        self._fine = []
        # Not in the first colours, which the states themselves have in the same view.
        for channel, color in zip(self._group("states"), cycle(SERIES[2:]), strict=False):
            fine = replace(
                channel,
                entity=f"intermediate/{escaped(channel.name)}",
                color=color,
                labels=["within"],
            )
            self._fine.append(fine)
        self._residual = Channel(
            entity=_RESIDUAL,
            name="log10 of the KKT residual",
            color=SERIES[2],
        )
        # Of each signal the state whose bound it is; empty where it is none.
        self._bounded_by = {}
        for signal, title in zip(scenario.valued_signals, scenario.signal_names, strict=True):
            self._bounded_by[title] = signal.bounded_state

    def record(
        self,
        first: int,
        columns: Mapping[str, Array],
        status: Sequence[str],
    ) -> None:
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
        first_and_last = [0, -1]
        ends = times(samples[first_and_last], time[first_and_last])
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
            table = column.reshape(len(column), -1)
            for channel, values in zip(channels, table.T, strict=True):
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
                # As the page about the run explains them.
                n_stages = values.shape[1]
                channel.labels = [f"+{stage}" for stage in range(n_stages)]
                stream.send([channel], rows, values)

    def _record_status(
        self,
        stream: Stream,
        samples: NDArray[np.int64],
        time: Array,
        status: Sequence[str],
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

    def _record_intermediate(
        self,
        stream: Stream,
        samples: NDArray[np.int64],
        time: Array,
    ) -> None:
        """Send what `intermediate` took since the last call."""
        if not self._within:
            return
        table = np.array(self._within)
        self._within.clear()
        moments, *states = table.T
        # A state at the end of a sample counts to that sample.
        next_row = np.searchsorted(time, moments)
        row = np.maximum(next_row - 1, 0)
        samples_of_moments = samples[row]
        rows = times(samples_of_moments, moments)
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
        if self._stream is None:
            return
        # The status is that of the last sample, if there was any.
        if self._status is None:
            self._stream.discard()
        else:
            self._stream.layout = self._layout()
            self._stream.close()
        self._stream = None

    def _group(self, *groups: str) -> list[Channel]:
        """The channels of the signals of these groups."""
        selected = []
        for kind, channels in self._kinds.items():
            if kind.group in groups:
                selected += channels
        return selected

    def _layout(self) -> rrb.Blueprint:
        """Four plots of the loop; in further tabs the others, the predictions, and the page."""
        along = axis(AT(seconds=0.0), AT(seconds=self._seconds))
        opening = self._opening_channels()
        others: list[rrb.View] = []
        for channel in self._group("states", "actions"):
            if channel not in opening:
                others.append(self._loop_view(channel, along))
        predictions: list[rrb.View] = []
        for channel in chain(*self._predicted.values()):
            if channel.window():
                predictions.append(view(channel.title, [channel], along, legend=False))
        views_of: dict[str, list[rrb.View]] = {
            "loop": [self._loop_view(channel, along) for channel in opening],
            "other states and inputs": others,
            "costs, disturbances, solver": self._further_views(along),
            "predictions": predictions,
        }
        return tabs(views_of)

    def _opening_channels(self) -> list[Channel]:
        """First view of the recording: two states and two inputs, or more of the others."""
        states = self._group("states")
        actions = self._group("actions")
        n_states = max(2, OPENING - len(actions))
        shown_states = states[:n_states]
        return shown_states + actions[: OPENING - len(shown_states)]

    def _further_views(self, along: rrb.TimeAxis) -> list[rrb.View]:
        """The plots of costs, of what acts on the plant, and of the solver."""
        views: list[rrb.View] = []
        for sensor in self._group("sensors"):
            # A signal that is no bound of a state has a view of its own.
            if self._bounded_by.get(sensor.name) == "":
                views.append(view(sensor.title, [sensor], along))
        for channel in self._group("costs"):
            views.append(view(channel.title, [channel], along))
        disturbances = self._group("disturbances")
        views.append(view("disturbances", disturbances, along))
        step_times = self._group("step_time")
        views.append(view("prepare and feedback time [s]", step_times, along))
        views.append(view(self._residual.name, [self._residual], along))
        status = rrb.StateTimelineView(
            name="QP status",
            contents=[f"/{_STATUS_ENTITY}"],
            time_view=along,
        )
        views.append(status)
        return views

    def _loop_view(self, channel: Channel, along: rrb.TimeAxis) -> rrb.TimeSeriesView:
        """The plot of a state or an action, with all that is known of it beside its samples."""
        name = channel.name
        drawn = [channel]
        # States within a sample lie in the view of the state, where a plant gave any.
        for fine in self._fine:
            if fine.name == name and fine.window():
                drawn.append(fine)
        # What is measured and estimated of a state is drawn over it.
        known = (f"measured[{name}]", f"estimated[{name}]")
        for sensor in self._group("sensors"):
            # So is a bound that moves.
            is_its_bound = self._bounded_by.get(sensor.name) == name
            if sensor.name in known or is_its_bound:
                drawn.append(sensor)
        return view(channel.title, drawn, along)


def _channels(
    kind: SignalKind,
    scenario: Scenario,
    units: Mapping[str, str],
) -> list[Channel]:
    """The signals of a kind as they are drawn; a unit not known is left empty."""
    # What is drawn into one view has unlike colours.
    first_color = FIRST_COLORS.get(kind.name, 0)
    colors = cycle(SERIES[first_color:])
    channels = []
    # A bound that moves is drawn as a signal, not as a line.
    moving = {signal.bounded_state for signal in scenario.signals or ()}
    for name, unit in kind.units(scenario, units).items():
        entity = str(kind.group)
        if kind.group in ALONE:
            entity = f"{kind.group}/{escaped(name)}"
        bounds = FREE
        # States and inputs are vectors; a scalar of the same name has no bounds.
        if kind.vector and name not in moving:
            bounds = scenario.limits.get(name, FREE)
        second_of_its_view = name in SECOND_OF_A_VIEW
        channel = Channel(
            entity=entity,
            name=name,
            unit=unit,
            color=SERIES[1] if second_of_its_view else next(colors),
            bounds=bounds,
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

{properties_table("run", properties)}

**Time** is the plant's. Sample k of a state is what the controller measured; the input,
disturbance and cost of sample k hold until sample k+1. The cost per sample is economic cost +
penalty of violating the state bounds (red lines).

**Predictions**: line +i is the QP's prediction, made at the cursor, of the sample i later.
"""
