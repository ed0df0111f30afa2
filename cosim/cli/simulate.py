"""`cosim simulate`: one closed-loop run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options import (
    JsonOption,
    OutOption,
    RecordOption,
    ScenarioOption,
    SeedOption,
    StepsOption,
)
from cosim.cli.output import output
from cosim.cli.run import Run, execute, show


def simulate(
    scenario: ScenarioOption = "paper",
    controller: Annotated[
        str,
        typer.Option(
            "--controller",
            "-c",
            help="naive, tuned, converged, optimal, a parameters file, or module:factory.",
        ),
    ] = "naive",
    steps: StepsOption = 1000,
    seed: SeedOption = 0,
    out: OutOption = Path("cosim-run"),
    record: RecordOption = False,
    json: JsonOption = False,
) -> None:
    """Run a controller on a scenario's plant.

    Writes trajectory.csv, timing.csv, summary.json, scenario.toml and, with --record, run.rrd.
    """
    with output(json) as out_:
        _, summary = execute(Run(scenario, controller, steps, seed, out, record), out_)
        show(summary, out_)
        out_.note(f"files are in {out.resolve()}")
        out_.json(summary)
