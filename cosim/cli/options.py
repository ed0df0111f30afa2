"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

MOST = 100_000_000
"""Samples of the longest run."""


def count(*names: str, least: int = 1, most: int = MOST, text: str) -> Any:
    """An option that is a number of samples, or of something else."""
    return typer.Option(*names, min=least, max=most, help=text)


ScenarioOption = Annotated[
    str,
    typer.Option("--scenario", "-s", help="Preset (paper, fouled, mismatched, …) or TOML file."),
]
StepsOption = Annotated[int, count("--steps", "-n", text="Number of samples.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Seed of the disturbances.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")]
RecordOption = Annotated[bool, typer.Option("--record", help="Write a Rerun recording too.")]
JobsOption = Annotated[
    int | None, count("--jobs", "-j", most=1024, text="Processes; default: one per core.")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option("--scheduler", help="Address of a Dask scheduler, in place of --jobs."),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print a JSON summary on standard output, nothing else.")
]
