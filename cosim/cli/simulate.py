"""`cosim simulate`: one closed-loop run."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

import cosim
from cosim.cli import output as cli

LONG_TABLE = 100_000
"""Samples of the longest run that is written as text: that takes as long as the run."""


def simulate(
    scenario: cli.ScenarioOption = "paper",
    controller: Annotated[str, typer.Option("--controller", "-c")] = "naive",
    steps: cli.StepsOption = 1000,
    seed: cli.SeedOption = 0,
    out: cli.OutOption = Path("cosim-run"),
    plot: Annotated[bool, typer.Option("--plot")] = False,
    record: cli.RecordOption = False,
    overwrite: cli.OverwriteOption = False,
    json: cli.JsonOption = False,
) -> None:
    """Run a controller on a scenario's plant.

    Writes trajectory.csv, timing.csv, summary.json, scenario.toml, with --plot trajectory.png and
    with --record run.rrd. Beyond 100 000 samples the tables are trajectory.parquet and
    timing.parquet with the same columns, if pyarrow is installed.
    Times by the clock are in timing.csv and the summary's `timing`. All other bytes are the same
    for the same command and seed.

    If the plant fails, the files hold the samples before, `ended` in summary.json has the reason,
    and the exit code is 2.

    Args:
        controller: naive, tuned, backed-off, cautious, lqr, pi, converged, optimal, a parameters
            file, or module:factory.
        plot: Draw trajectory.png too, of 2 to 20 000 samples.
    """
    with cli.output(json) as out_:
        from cosim.core.errors import CosimError, PlantError
        from cosim.core.files import staged
        from cosim.core.run_files import RUN_FILES

        # Before the run, which may take long.
        if plot and not 1 < steps <= cli.MOST_DRAWN:
            raise CosimError(f"--plot draws 2 to {cli.MOST_DRAWN} samples, not {steps}")
        loaded = cosim.Scenario.load(scenario)
        folder = cli.open_folder(out, overwrite)
        out_.announce(loaded.plant.fmu)
        with staged(folder, RUN_FILES) as stage:
            summary = _simulate(loaded, controller, steps, seed, stage, plot, record, out_.live)
            cli.write_summary(stage, summary)
        rows = [
            ("economic cost", f"{summary['economic_cost']:.3f}"),
            ("mean violation", f"{summary['mean_violation']:.5f}"),
            ("violating share", f"{100 * summary['violating_share']:.2f} %"),
            ("J = mean(economic cost + penalty)", f"{summary['J']:.3f}"),
            ("failures", str(summary["failures"])),
        ]
        for name, quantiles in summary["timing"].items():
            # It says how the times came about, and is none.
            if name == "functions":
                continue
            median = quantiles["median_us"]
            p99 = quantiles["p99_us"]
            rows.append((f"{name} time, median / 99 %", f"{median:.1f} / {p99:.1f} µs"))
        title = f"{controller} on {loaded.name}, {summary['samples']} samples, seed {seed}"
        out_.table(title, ("per sample", "value"), rows)
        out_.note(f"files are in {out.resolve()}")
        out_.json(summary)
        # Only now: the samples before the failure are worth their files.
        ended = summary.get("ended")
        if ended:
            raise PlantError(f"{ended}; they are in {out.resolve()}")


def _simulate(
    scenario: cosim.Scenario,
    controller: str,
    steps: int,
    seed: int,
    folder: Path,
    plot: bool,
    record: bool,
    progress: bool,
) -> dict[str, Any]:
    """Simulate, and write all files but summary.json to an empty folder.

    Returns:
        The summary; `ended` in it says why a run stopped before its last sample.
    """
    from importlib.metadata import version

    from controllers import compile_functions
    from controllers.factories import parameters_hash
    from cosim.core.errors import RunEndedError
    from cosim.core.simulation import functions_of

    recorder = None
    if record:
        from cosim.recording import RerunRecorder

        recorder = RerunRecorder(folder / "run.rrd")
    # States within a step have no place but in a recording.
    between = recorder.intermediate if recorder else None
    with cosim.FmuPlant(scenario, intermediate=between) as plant:
        law = cosim.build_controller(controller, scenario)
        compile_functions(law, steps)
        ended = ""
        try:
            run = cosim.simulate(plant, law, steps, seed, recorder=recorder, progress=progress)
        # The samples before the failure may show what led to it.
        except RunEndedError as error:
            run = error.trajectory
            ended = str(error)
        summary: dict[str, Any] = {
            "version": version("rti-cosim"),
            "scenario": scenario.name,
            "scenario_hash": scenario.hash,
            "fmu": plant.fmu_path.name,
            "fmu_sha256": plant.fmu_sha256,
            "controller": controller,
            "parameters_hash": parameters_hash(law) or None,
            "seed": seed,
            **run.summary(),
            "timing": run.timing_summary() | {"functions": functions_of(law)},
        }
    if ended:
        summary["ended"] = ended
    # pyarrow comes with the extra `view`; without it text is what there is.
    if len(run) > LONG_TABLE and find_spec("pyarrow"):
        run.write_parquet(folder / "trajectory.parquet")
        run.write_timing_parquet(folder / "timing.parquet")
    else:
        run.write_csv(folder / "trajectory.csv")
        run.write_timing_csv(folder / "timing.csv")
    # A run that ended early may be one sample, which makes no line.
    if plot and len(run) > 1:
        run.plot(folder / "trajectory.png")
    (folder / "scenario.toml").write_text(scenario.to_toml(), "utf-8")
    return summary
