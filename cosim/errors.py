"""Errors whose message is meant for the user: `CosimError`, and those of the co-simulation."""

from fmus.errors import CosimError

__all__ = [
    "CapabilityError",
    "ComparisonError",
    "ControllerLookupError",
    "CosimError",
    "EvaluationError",
    "FailedRunsError",
    "FigureError",
    "PlantError",
    "RecordingError",
    "ResultsError",
    "ScenarioError",
    "StudyError",
    "TrajectoryError",
]


class ScenarioError(CosimError):
    """A scenario document that cannot be found, read or validated."""


class PlantError(CosimError):
    """The plant cannot be loaded, or refused a call."""


class CapabilityError(PlantError):
    """A capability was asked for that this FMU does not have, e.g. saving its state."""


class ControllerLookupError(CosimError):
    """A controller's name, `module:factory` or parameters file that leads nowhere."""


class TrajectoryError(CosimError):
    """A trajectory file is unreadable, or its signals are inconsistent."""


class RecordingError(CosimError):
    """A recording that cannot be written, read or shown."""


class FigureError(CosimError):
    """A figure that cannot be drawn or written."""


class ComparisonError(CosimError):
    """Two runs that cannot be compared as asked."""


class EvaluationError(CosimError):
    """An evaluation cannot be set up, or its workers failed."""


class ResultsError(CosimError):
    """Stored results are missing, malformed, or differ from recomputed ones."""


class StudyError(CosimError):
    """A study file is unreadable, or its study cannot be run or reported."""


class FailedRunsError(StudyError):
    """Runs of a study that failed, while all others were done."""
