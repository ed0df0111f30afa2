"""Rerun recordings: of runs, of training and of comparisons; the only importer of rerun."""

from cosim.recording.overlay import record_comparison
from cosim.recording.reader import Recording, read_recording, read_signals, summarise
from cosim.recording.run_recorder import RerunRecorder
from cosim.recording.training_recorder import TrainingRecorder
from cosim.recording.viewer import open_viewer, render

__all__ = [
    "Recording",
    "RerunRecorder",
    "TrainingRecorder",
    "open_viewer",
    "read_recording",
    "read_signals",
    "record_comparison",
    "render",
    "summarise",
]
