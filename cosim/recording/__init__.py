"""Rerun recordings: of runs, of training and of comparisons; the only importer of rerun."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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
_HOMES = {
    "Recording": "reader",
    "RerunRecorder": "run_recorder",
    "TrainingRecorder": "training_recorder",
    "open_viewer": "viewer",
    "read_recording": "reader",
    "read_signals": "reader",
    "record_comparison": "overlay",
    "render": "viewer",
    "summarise": "reader",
}

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


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cosim.recording' has no attribute '{name}'")
    return getattr(import_module(f"cosim.recording.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
