"""`cosim demo`: the benchmark's first look."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.output import JsonOption, output
from cosim.cli.run import Run, execute, show
from cosim.cli.simulate import SeedOption, StepsOption


def demo(
    steps: StepsOption = 500,
    seed: SeedOption = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path(
        "cosim-demo"
    ),
    json: JsonOption = False,
) -> None:
    """Control the stochastic evaporator by naive RTI-NMPC; write a table, a plot, a recording.

    Writes trajectory.csv, trajectory.png, run.rrd, summary.json, timing.csv and scenario.toml.
    """
    with output(json) as out_:
        trajectory, summary = execute(Run("paper", "naive", steps, seed, out, True), out_)
        from cosim.figures import plot_trajectory

        plot_trajectory(trajectory, trajectory.scenario, out / "trajectory.png")
        show(summary, out_)
        folder = out.resolve()
        out_.note(
            f"plot       {folder / 'trajectory.png'}\n"
            f"recording  {folder / 'run.rrd'}   (look at it with: cosim view {out / 'run.rrd'})\n"
            f"signals    {folder / 'trajectory.csv'}"
        )
        out_.json(summary | {"out": str(out)})
