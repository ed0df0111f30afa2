"""Rerun recordings of runs, trainings and overlays; the only importer of rerun."""

from cosim.recording.overlay import record_overlay
from cosim.recording.read import Recording, read_recording, summarise
from cosim.recording.training import record_training
from cosim.recording.viewer import open_viewer, render
from cosim.recording.write import RerunRecorder

__all__ = [
    "Recording",
    "RerunRecorder",
    "open_viewer",
    "read_recording",
    "record_overlay",
    "record_training",
    "render",
    "summarise",
]
