"""The plants as FMUs: C sources, tables of variables, build and the built files."""

from __future__ import annotations

from pathlib import Path

__all__ = ["NAMES", "PLANTS", "BuildError", "CheckError", "FmuError", "path"]

NAMES = ("evaporator", "evaporator_fmi3")
PLANTS = ("reactor", "tanks")


class FmuError(Exception):
    """Base of every error that `fmus` raises for a bad input or environment."""


class BuildError(FmuError):
    """No usable C compiler, or the compiler refused the sources."""


class CheckError(FmuError):
    """The file to check is missing or is not an FMU."""


def path(name: str = "evaporator") -> Path:
    """The path of a shipped FMU: ``evaporator_fmi3`` is FMI 3.0, the others FMI 2.0.

    Raises FmuError for another name.
    """
    if name not in (*NAMES, *PLANTS):
        raise FmuError(f"there is no FMU {name!r}; shipped are {', '.join((*NAMES, *PLANTS))}")
    return Path(__file__).parent / f"{name}.fmu"
