"""Algorithms by name, from the entry-point group `cosim.algorithms`."""

from __future__ import annotations

from importlib.metadata import entry_points

from cosim.plugins import load_plugin
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
    if name not in known and ":" not in name:
        raise AlgorithmLookupError(
            f"unknown algorithm '{name}'{suggestion(name, known)}; registered are "
            f"{', '.join(sorted(known))}, or give module:Class"
        )
    target = known[name].value if name in known else name
    found = load_plugin(target, f"algorithm '{name}'", AlgorithmLookupError)
    missing = [
        part
        for part in ("Configuration", "observe", "state", "restore")
        if not hasattr(found, part)
    ]
    if missing:
        raise AlgorithmLookupError(f"algorithm '{name}' lacks {', '.join(missing)}")
    algorithm: type[Algorithm] = found
    return algorithm
