"""The blueprint of a run: which view stands where, and what range it shows."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr
import rerun.blueprint as rrb

from cosim.recording import diagram, horizon
from cosim.recording.channels import Channel, Range
from cosim.recording.glyphs import drawable
from cosim.recording.stream import TIME

GROUPS = ("states", "actions", "disturbances", "costs", "step_time")


def series(
    name: str,
    contents: Sequence[str],
    axis: rrb.TimeAxis,
    window: Range | None = None,
    *,
    legend: bool = False,
) -> rrb.TimeSeriesView:
    """A plot of the entities over time."""
    return rrb.TimeSeriesView(
        name=drawable(name),
        origin="/",
        contents=list(contents),
        axis_x=axis,
        axis_y=rrb.ScalarAxis(range=window) if window else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
    )


def time_axis(duration: float) -> rrb.TimeAxis:
    """Horizontal axis that shows the whole run of `duration` seconds."""
    whole = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(seconds=0.0),
        end=rr.TimeRangeBoundary.absolute(seconds=duration),
    )
    return rrb.TimeAxis(view_range=whole)


def run_blueprint(duration: float, channels: Sequence[Channel], predicts: bool) -> rrb.Blueprint:
    """Left: states and actions with their bounds; middle: causes, costs, solver; right: the rest.

    The right column has the prediction at the cursor, the signal flow and the run's description.
    """
    axis = time_axis(duration)
    group = {name: [c for c in channels if c.group == name] for name in GROUPS}

    def alone(channel: Channel) -> rrb.TimeSeriesView:
        return series(channel.title, [f"/{channel.entity}/**"], axis, channel.window())

    def bundle(title: str, name: str) -> rrb.TimeSeriesView:
        return series(title, [f"/{name}"], axis, union(group[name]), legend=True)

    loop = rrb.Vertical(*map(alone, [*group["states"], *group["actions"]]))
    causes = rrb.Vertical(
        *map(alone, group["costs"]),
        bundle("disturbances", "disturbances"),
        bundle("prepare and feedback time [s]", "step_time"),
        series("log10 of the KKT residual", ["/display/log_residual"], axis),
        rrb.StateTimelineView(name="QP status", contents=["/solver/status"], time_view=axis),
        row_shares=[2] * len(group["costs"]) + [2, 1.6, 1.4, 1],
    )
    rows = len(group["states"]) + len(group["actions"])
    prediction = rrb.Spatial2DView(
        name="prediction at the cursor",
        origin=f"/{horizon.ENTITY}",
        contents=["$origin/frame/**", "$origin/states", "$origin/actions"],
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-0.75, horizon.WIDTH + 0.4],
            y_range=[-0.4, rows * (horizon.HEIGHT + horizon.GAP)],
        ),
    )
    flow = rrb.GraphView(
        name="signal flow",
        origin=f"/{diagram.ENTITY}",
        visual_bounds=rrb.VisualBounds2D(x_range=[-340, 340], y_range=[-80, 240]),
    )
    about = rrb.TextDocumentView(name="about this run", origin="/about")
    machinery = rrb.Vertical(
        *([prediction] if predicts else []),
        rrb.Tabs(flow, about),
        row_shares=[2, 1] if predicts else [1],
    )
    return framed(rrb.Horizontal(loop, causes, machinery, column_shares=[4, 3, 3]))


def union(channels: Sequence[Channel]) -> Range | None:
    """Range of view that holds every channel's."""
    windows = [channel.window() for channel in channels]
    return (min(low for low, _ in windows), max(high for _, high in windows)) if windows else None


def sample_axis(samples: int) -> rrb.TimeAxis:
    """Horizontal axis that shows samples 0 … `samples`."""
    whole = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(seq=0),
        end=rr.TimeRangeBoundary.absolute(seq=samples),
    )
    return rrb.TimeAxis(view_range=whole)


def framed(root: rrb.Container, timeline: str = TIME) -> rrb.Blueprint:
    """The views with a paused time panel on a timeline, and no other panels in the way."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused"),
    )
