"""Errors whose message is meant for the user: `CosimError`, and those of the co-simulation."""

import warnings
from typing import Any

from fmus.errors import CosimError

__all__ = [
    "CapabilityError",
    "ComparisonError",
    "ControllerLookupError",
    "CosimError",
    "CosimWarning",
    "EvaluationError",
    "FailedRunsError",
    "FigureError",
    "FmuWarning",
    "PlantError",
    "RecordingError",
    "ResultsError",
    "RunEndedError",
    "ScenarioError",
    "StudyError",
    "TrajectoryError",
    "warn",
]


class CosimWarning(UserWarning):
    """Base of every warning that the four packages give; its message is one line for the user."""


class ScenarioError(CosimError):
    """A scenario document that cannot be found, read or validated."""


class PlantError(CosimError):
    """The plant cannot be loaded, or refused a call."""


class RunEndedError(PlantError):
    """The plant failed in mid run; `trajectory` holds the samples before it."""

    trajectory: Any = None


class CapabilityError(PlantError):
    """A capability was asked for that this FMU does not have, e.g. saving its state."""


class FmuWarning(CosimWarning):
    """An FMU is used although its model description has flaws."""


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


def warn(message: str, category: type[CosimWarning]) -> None:
    """Warn the user, once for each message.

    Args:
        message: One line.
        category: Class of the warning.
    """
    warnings.warn_explicit(message, category, category.__module__, 0, registry=_WARNED)


_WARNED: dict[Any, Any] = {}
"""The messages that were shown: Python's own record goes by the line of code that warns."""
