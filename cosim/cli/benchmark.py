"""`cosim benchmark`: runs the folder `benchmarks` of a checkout."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from cosim.errors import CosimError


def benchmark(
    words: Annotated[list[str], typer.Argument(help="plant, controllers, learning, …; options.")],
) -> None:
    """Measure speed: each figure in µs beside a reference from the same run."""
    root = Path(__file__).parents[2]
    if not (root / "benchmarks").is_dir():
        raise CosimError(
            "the benchmarks are not part of the installed package: run the command from a checkout "
            "of the sources, installed with pip install -e ."
        )
    raise typer.Exit(subprocess.call([sys.executable, "-m", "benchmarks", *words], cwd=root))
