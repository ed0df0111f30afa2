"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ScenarioOption = Annotated[
    str,
    typer.Option("--scenario", "-s", help="Preset (paper, fouled, mismatched, …) or TOML file."),
]
StepsOption = Annotated[
    int, typer.Option("--steps", "-n", min=1, max=100_000_000, help="Number of samples.")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Seed of the disturbances.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")]
RecordOption = Annotated[bool, typer.Option("--record", help="Write a Rerun recording too.")]
JobsOption = Annotated[
    int | None,
    typer.Option("--jobs", "-j", min=1, max=1024, help="Processes; default: one per core."),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option("--scheduler", help="Address of a Dask scheduler, in place of --jobs."),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print a JSON summary on standard output, nothing else.")
]
