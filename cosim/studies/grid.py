"""Grids of a study file: a list in a case's table stands for a case of each of its values."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, get_args, get_origin

from cosim.core.errors import StudyError
from cosim.studies.document import CaseTable
from learning.algorithm import load_algorithm

GRID_FIELDS = ("samples", "start", "nmpc")
"""Fields of a case, beside its settings, that may be a grid."""
SEQUENCES = (list, tuple, set, frozenset)


@dataclass(frozen=True)
class GridPoint:
    """One point of a case's grid.

    Attributes:
        label: the coordinates that vary within the grid, as they stand in the point's name.
        fields: value of each of `GRID_FIELDS`.
        settings: value of each of the algorithm's settings that the table gives.
    """

    label: str
    fields: dict[str, Any]
    settings: dict[str, Any]


def grid_points(table: CaseTable) -> Iterator[GridPoint]:
    """The points of the grid of a table with an algorithm, the last axis fastest.

    Raises StudyError where an axis is empty, and what an unknown algorithm raises.
    """
    axes = _axes(table)
    for coordinates in product(*axes.values()):
        parts = []
        fields = {}
        settings = {}
        for (name, values), value in zip(axes.items(), coordinates, strict=True):
            # A coordinate that all points have tells no two of them apart.
            if len(values) > 1:
                parts.append(f"{name}={_text(value)}")
            if name in GRID_FIELDS:
                fields[name] = value
            else:
                settings[name] = value
        yield GridPoint(" ".join(parts), fields, settings)


def _axes(table: CaseTable) -> dict[str, list[Any]]:
    """Values of each field and setting that a case's grid runs over; raises StudyError."""
    axes = {}
    for name in GRID_FIELDS:
        value = getattr(table, name)
        axes[name] = value if isinstance(value, list) else [value]
    for name, value in table.settings.items():
        axes[name] = _values_of_setting(str(table.algorithm), name, value)
    for name, values in axes.items():
        # An empty axis would leave no case of the table, without a word.
        if not values:
            raise StudyError(f"case '{table.name}': the grid of {name} is empty")
    return axes


def _values_of_setting(algorithm: str, setting: str, value: Any) -> list[Any]:
    """Values of a setting: a list is a grid, but for a setting that is a list itself."""
    if not isinstance(value, list):
        return [value]
    is_list_of_lists = bool(value) and all(isinstance(item, list) for item in value)
    configuration = load_algorithm(algorithm).Configuration
    field = configuration.model_fields.get(setting)
    # A setting that there is not is refused later, with the settings that there are.
    takes_list = field is not None and _is_sequence(field.annotation)
    if takes_list and not is_list_of_lists:
        return [value]
    return value


def _is_sequence(annotation: Any) -> bool:
    """Whether a field of this type takes a list, as one of its alternatives too."""
    if annotation in SEQUENCES or get_origin(annotation) in SEQUENCES:
        return True
    # `tuple[int, ...]` has an ellipsis, which is no type.
    alternatives = [part for part in get_args(annotation) if part is not Ellipsis]
    return any(_is_sequence(part) for part in alternatives)


def _text(value: Any) -> str:
    """A value of a grid as it stands in the name of its case."""
    if isinstance(value, str):
        # A parameters file is told by its name, wherever it lies.
        return Path(value).stem
    # Labels are parted by blanks, so that a label has none within a value.
    return json.dumps(value).replace(" ", "")
