"""Modules that are imported only with the extra that brings the tool that they drive."""

OPTIONAL = (
    "fmus.checks.ecospy_check",
    "fmus.checks.libcosimpy_check",
)
