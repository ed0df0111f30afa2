"""Modules that are imported only with the extra that brings the tool that they drive."""

OPTIONAL = (
    "controllers.mpcrl_nmpc",
    "fmus.checks.ecospy_check",
    "fmus.checks.libcosimpy_check",
)
