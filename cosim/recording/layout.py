"""The layout of a recording in the viewer: plots, their axes, tabs, and the page beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun as rr
import rerun.blueprint as rrb

from cosim.core.result import markdown_table
from cosim.recording.read import TIMELINE
from cosim.recording.stream import Channel, drawable

AT = rr.TimeRangeBoundary.absolute
OPENING = 4
"""Plots that a recording opens on; all others are in further tabs."""


def axis(start: rr.TimeRangeBoundary, end: rr.TimeRangeBoundary) -> rrb.TimeAxis:
    """Horizontal axis over a whole run.

    Args:
        start: where it begins, a time or a sample.
        end: where it ends.
    """
    return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))


def view(
    title: str,
    channels: Sequence[Channel],
    along: rrb.TimeAxis,
    *,
    legend: bool | None = None,
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
    entities = [channel.entity for channel in channels]
    # Channels of one entity are named once.
    for entity in dict.fromkeys(entities):
        contents.append(f"/{entity}")
        contents.append(f"/bounds/{entity}/**")
    # Without a range the viewer chooses one.
    ordinate = None
    if lows:
        ordinate = rrb.ScalarAxis(range=(min(lows), max(highs)))
    if legend is None:
        legend = len(channels) > 1
    corner = rrb.Corner2D.RightTop
    return rrb.TimeSeriesView(
        name=drawable(title),
        # Contents are named from the root, since bounds are not below their signal.
        origin="/",
        contents=contents,
        axis_x=along,
        axis_y=ordinate,
        plot_legend=rrb.PlotLegend(corner=corner, visible=legend),
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


def tabs(
    views_of: Mapping[str, Sequence[rrb.View]],
    timeline: str = TIMELINE,
) -> rrb.Blueprint:
    """A layout of a tab for each title that has views, and one of the page about the recording.

    Args:
        views_of: views by title, which a tab has in a grid; the recording opens on the first.
        timeline: that of the time panel.
    """
    grids = []
    for name, views in views_of.items():
        if views:
            columns = 2 if len(views) <= OPENING else 3
            grids.append(rrb.Grid(*views, grid_columns=columns, name=name))
    page = rrb.TextDocumentView(name="about", origin="/about")
    return layout(rrb.Tabs(*grids, page), timeline)


def properties_table(title: str, values: Mapping[str, object]) -> str:
    """Properties of a recording as a table in Markdown.

    Args:
        title: heading of the names.
        values: the properties by name.
    """
    rows = []
    for key, value in values.items():
        name = key.replace("_", " ")
        rows.append((name, str(value)))
    return markdown_table((title, ""), rows)
