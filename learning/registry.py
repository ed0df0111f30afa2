"""Algorithms by name, from the entry-point group `cosim.algorithms`."""

from __future__ import annotations

import re
from importlib.metadata import EntryPoint, entry_points

from cosim.validation import suggestion
from learning.errors import AlgorithmLookupError
from learning.protocols import Algorithm

GROUP = "cosim.algorithms"


def algorithms() -> list[str]:
    """Names of the algorithms that are registered."""
    return sorted(point.name for point in entry_points(group=GROUP))


def load_algorithm(name: str) -> type[Algorithm]:
    """Class of an algorithm by registered name or `module:Class`; raises AlgorithmLookupError."""
    known = {point.name: point for point in entry_points(group=GROUP)}
    is_target = re.fullmatch(r"[\w.]+:[\w.]+", name)
    point = EntryPoint(name, name, GROUP) if is_target else known.get(name)
    if point is None:
        raise AlgorithmLookupError(
            f"unknown algorithm '{name}'{suggestion(name, known)}; registered are "
            f"{', '.join(sorted(known))}, or give module:Class"
        )
    try:
        found = point.load()
    except (ImportError, AttributeError) as error:
        raise AlgorithmLookupError(f"algorithm '{name}' cannot be imported: {error}") from error
    missing = [
        part
        for part in ("Configuration", "observe", "state", "restore")
        if not hasattr(found, part)
    ]
    if missing:
        raise AlgorithmLookupError(f"algorithm '{name}' lacks {', '.join(missing)}")
    algorithm: type[Algorithm] = found
    return algorithm
