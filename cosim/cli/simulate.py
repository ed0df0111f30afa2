"""`cosim simulate`: one closed-loop run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.cli.options import (
    JsonOption,
    OutOption,
    RecordOption,
    ScenarioOption,
    SeedOption,
    StepsOption,
)
from cosim.cli.output import Output, dump, load_scenario, open_folder, output


def simulate(
    scenario: ScenarioOption = "paper",
    controller: Annotated[
        str,
        typer.Option(
            "--controller",
            "-c",
            help="naive, tuned, commissioned, converged, optimal, a parameters file, or "
            "module:factory.",
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
    Everything that a clock measured is in timing.csv and the summary's `timing`; all other bytes
    are the same for the same command and seed.
    """
    with output(json) as out_:
        from controllers import compile_functions
        from cosim.files import write_atomically
        from cosim.plant import FmuPlant
        from cosim.plugins import build_controller
        from cosim.simulation import simulate as run

        loaded = load_scenario(scenario)
        folder = open_folder(out).absolute()  # an FMU may change the working directory
        out_.announce(loaded)
        with FmuPlant(loaded) as plant:
            law = build_controller(controller, loaded)
            compile_functions(law, steps)
            recorder = None
            if record:
                from cosim.recording import RerunRecorder

                recorder = RerunRecorder(folder / "run.rrd")
            with out_.progress(f"{controller} on {loaded.name}", steps) as progress:
                trajectory = run(plant, law, steps, seed, recorder=recorder, progress=progress)
            summary = _about(controller, law, plant) | {"seed": seed, **trajectory.summary()}
            functions = summary.pop("functions")
            summary["timing"] = trajectory.timing_summary() | {"functions": functions}
        if not record:
            # A recording that another run left would stand beside this one's signals.
            (folder / "run.rrd").unlink(missing_ok=True)
        trajectory.write_csv(folder / "trajectory.csv")
        trajectory.write_timing_csv(folder / "timing.csv")
        write_atomically(folder / "scenario.toml", loaded.to_toml())
        write_atomically(folder / "summary.json", dump(summary))
        _show(summary, out_)
        out_.note(f"files are in {out.resolve()}")
        out_.json(summary)


def _about(name: str, controller: Any, plant: Any) -> dict[str, Any]:
    """What the summary says of the parts of the run."""
    from importlib.metadata import version

    from cosim.protocols import functions_of

    return {
        "version": version("rti-cosim"),
        "scenario": plant.scenario.name,
        "scenario_hash": plant.scenario.hash,
        "fmu": plant.fmu_path.name,
        "fmu_sha256": plant.fmu_sha256,
        "controller": name,
        "parameters_hash": getattr(getattr(controller, "parameters", None), "hash", None),
        "functions": functions_of(controller),
    }


def _show(summary: dict[str, Any], output: Output) -> None:
    title = "{controller} on {scenario}, {samples} samples, seed {seed}".format(**summary)
    rows = [
        ("economic cost", f"{summary['economic_cost']:.3f}"),
        ("mean violation", f"{summary['mean_violation']:.5f}"),
        ("violating share", f"{100 * summary['violating_share']:.2f} %"),
        ("J = mean(economic cost + penalty)", f"{summary['J']:.3f}"),
        ("failures", str(summary["failures"])),
    ]
    rows += [
        (f"{name} time, median / 99 %", f"{t['median_us']:.1f} / {t['p99_us']:.1f} µs")
        for name, t in summary["timing"].items()
        if name != "functions"
    ]
    output.table(title, ("per sample", "value"), rows)
