"""`cosim benchmark`: speed, as medians and ratios of one run."""

from __future__ import annotations

from typing import Annotated

import typer

from cosim.cli.output import JsonOption, output
from cosim.cli.simulate import ScenarioOption

app = typer.Typer(help="Measure speed: medians, and ratios within one run.", no_args_is_help=True)


@app.callback()
def benchmark() -> None:
    """Measure speed: medians, and ratios within one run."""


@app.command()
def plant(
    scenario: ScenarioOption = "paper",
    fmu: Annotated[
        str | None, typer.Option("--fmu", help="FMU in place of the scenario's, name or path.")
    ] = None,
    steps: Annotated[int, typer.Option("--steps", min=100, help="Steps per repetition.")] = 5000,
    json: JsonOption = False,
) -> None:
    """Time per plant step against fmpy's convenience methods and simulate_fmu.

    A step sets the inputs, reads stage cost and disturbances, steps, and reads the states.
    """
    with output(json) as out_:
        from cosim.plant.benchmark import measure

        result = measure(scenario, fmu, steps)
        rows = [
            (row["name"], f"{row['median_us']:.2f}", f"{row['minimum_us']:.2f}", row["ratio_text"])
            for row in result["rows"]
        ]
        header = ("per step", "median µs", "minimum µs", "ratio")
        out_.table(f"plant {result['fmu']}, {steps} steps a repetition", header, rows)
        out_.json(result)
