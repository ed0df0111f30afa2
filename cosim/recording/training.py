"""Records a training: its log, and how each block of θ changed."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun.blueprint as rrb
from rerun import escape_entity_path_part as escaped

from cosim.recording.layout import AT, axis, properties_table, tabs, view
from cosim.recording.read import SAMPLE
from cosim.recording.stream import SERIES, Channel, Stream, times

if TYPE_CHECKING:
    from learning.training import Training

OPENING_COLUMNS = ("J", "greedy_J", "greedy_violating_share", "td_error")
"""Columns of the log that the recording opens on."""


def record_training(path: str | Path, training: Training) -> None:
    """Write a recording of a training.

    The signals are the log's columns and `increment/<block>`, the change of a block of θ since the
    start, (K, size).

    Args:
        path: of the file.
        training: what `train` returned.

    Raises:
        OSError: if the file cannot be begun.
        RecordingError: if it is not written whole.
    """
    run = training.run
    log = training.log()
    properties = {
        "algorithm": run.algorithm,
        "scenario": run.scenario.name,
        "scenario_hash": run.scenario.hash,
        "samples": run.samples,
        "seed": run.seed,
        **run.configuration.model_dump(mode="json"),
    }
    samples = log["samples"].astype(np.int64)
    rows = times(samples)
    last = int(samples[-1]) if len(samples) else 0
    # A training has no time: its axis is the number of the sample.
    along = axis(AT(seq=0), AT(seq=last))
    title = f"{run.algorithm} on {run.scenario.name}"
    page = f"# {title}\n\n{properties_table('training', properties)}"
    blocks = training.parameters.blocks
    theta_views: list[rrb.View] = []
    opening_views: list[rrb.View] = []
    log_views: list[rrb.View] = []
    with Stream(path, title, page, properties) as stream:
        for name, values in training.theta().items():
            labels = blocks.labels[blocks.slices[name]]
            block = Channel(
                entity=f"increment/{escaped(name)}",
                name=f"increment/{name}",
                labels=list(labels),
            )
            stream.send([block], rows, values)
            theta_views.append(view(f"change of {name}", [block], along))
        for (name, values), color in zip(log.items(), cycle(SERIES), strict=False):
            # What is not measured at every row is drawn as dots.
            sparse = bool(np.isnan(values).any())
            column = Channel(
                entity=f"log/{escaped(name)}",
                name=name,
                color=color,
                points=sparse,
            )
            stream.send([column], rows, values)
            views = opening_views if name in OPENING_COLUMNS else log_views
            views.append(view(name, [column], along))
        views_of = {"learning": opening_views, "log": log_views, "θ": theta_views}
        stream.layout = tabs(views_of, SAMPLE)
