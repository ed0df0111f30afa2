"""The moment of a recording at which there is most to see."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosim.errors import RecordingError
from cosim.penalty import VIOLATING
from cosim.recording.reader import read_recording

VIOLATION = "violation"


def telling_moment(path: str | Path) -> float | None:
    """Where the cursor says most: the worst violation of a run, else its end; a training's end.

    In seconds of the run, or a sample's number where there is no time. None of a recording that
    is not one of this package, or cannot be read: to say so is the viewer's.
    """
    try:
        recording = read_recording(path)
    except RecordingError:
        return None
    if not len(recording.samples):
        return None
    where = np.where(np.isfinite(recording.time), recording.time, recording.samples)
    violation = recording.signals.get(VIOLATION, np.zeros(1))
    if not np.nanmax(violation, initial=0.0) > VIOLATING:
        return float(where[-1])
    return float(where[int(np.nanargmax(violation))])
