"""Errors of the package `fmus`."""

from __future__ import annotations


class FmuError(Exception):
    """Base of every error that `fmus` raises for a bad input or environment."""


class BuildError(FmuError):
    """No usable C compiler, or the compiler refused the sources."""


class CheckError(FmuError):
    """The file to check is missing or is not an FMU."""
