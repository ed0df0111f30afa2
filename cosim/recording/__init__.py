"""Rerun recordings: of runs, of training and of comparisons; the only importer of rerun."""

from typing import TYPE_CHECKING

from cosim.lazy import on_first_use

if TYPE_CHECKING:
    from cosim.recording.overlay import record_comparison as record_comparison
    from cosim.recording.reader import Recording as Recording
    from cosim.recording.reader import read_recording as read_recording
    from cosim.recording.reader import read_signals as read_signals
    from cosim.recording.reader import summarise as summarise
    from cosim.recording.run_recorder import RerunRecorder as RerunRecorder
    from cosim.recording.training_recorder import TrainingRecorder as TrainingRecorder
    from cosim.recording.viewer import open_viewer as open_viewer
    from cosim.recording.viewer import render as render

# Imported on first use: a recorded run must not pay, in time and 80 MB, for the statistics and
# colours of training's recordings.
__getattr__, __dir__ = on_first_use(
    __name__,
    {
        "Recording": "cosim.recording.reader",
        "RerunRecorder": "cosim.recording.run_recorder",
        "TrainingRecorder": "cosim.recording.training_recorder",
        "open_viewer": "cosim.recording.viewer",
        "read_recording": "cosim.recording.reader",
        "read_signals": "cosim.recording.reader",
        "record_comparison": "cosim.recording.overlay",
        "render": "cosim.recording.viewer",
        "summarise": "cosim.recording.reader",
    },
)

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
