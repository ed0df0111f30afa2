"""`cosim benchmark`: speed, as medians and ratios of one run."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cosim.cli.options import JsonOption, ScenarioOption
from cosim.cli.output import output

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
    steps: Annotated[
        int, typer.Option("--steps", min=100, max=100_000_000, help="Steps per repetition.")
    ] = 5000,
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


@app.command()
def evaluation(
    scenario: ScenarioOption = "paper",
    controllers: Annotated[
        str, typer.Option("--controllers", "-c", help="Comma-separated, as for evaluate.")
    ] = "naive",
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, max=1_000_000, help="Number of seeds.")
    ] = 100,
    steps: Annotated[
        int, typer.Option("--steps", "-n", min=1, max=100_000_000, help="Samples per run.")
    ] = 2000,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", min=2, max=1024, help="Workers to compare.")
    ] = 2,
    json: JsonOption = False,
) -> None:
    """Time of an evaluation by several workers against one, starting them included."""
    with output(json) as out_:
        from functools import partial

        from cosim.cli.compose import load_scenario
        from cosim.cli.evaluate import named_controllers
        from cosim.evaluation.benchmark import measure
        from cosim.lookup import build_controller

        factories = {
            name: partial(build_controller, spec)
            for name, spec in named_controllers(controllers).items()
        }
        result = measure(load_scenario(scenario), factories, seeds, steps, jobs)
        rows = [
            (f"{workers} workers", *(f"{value:.2f}" for value in sorted(values)))
            for workers, values in result["timing"]["seconds_by_jobs"].items()
        ]
        out_.table(f"{seeds} seeds × {steps} samples", ("wall time", "s", "s", "s"), rows)
        out_.note(f"speed-up {result['timing']['speed_up']:.2f}")
        out_.note("same bytes" if result["same_bytes"] else "the bytes DIFFER")
        out_.json(result)
    if not result["same_bytes"]:
        raise typer.Exit(1)


@app.command()
def controllers(
    scenario: ScenarioOption = "paper",
    steps: Annotated[
        int, typer.Option("--steps", "-n", min=50, max=1_000_000, help="Samples of each run.")
    ] = 2000,
    every: Annotated[
        int,
        typer.Option(
            "--every", min=1, max=1_000_000, help="Compare every so many samples with the others."
        ),
    ] = 10,
    json: JsonOption = False,
) -> None:
    """Time of each phase of an RTI-NMPC sample per QP backend, along closed-loop runs.

    In the same run: ProxQP called cold through qpsolvers on the same QPs, and IPOPT on the
    nonlinear programme at the same states.
    """
    with output(json) as out_:
        from cosim.cli.benchmark_controllers import BACKENDS, measure
        from cosim.cli.compose import load_scenario

        with out_.progress("controllers", len(BACKENDS) * steps) as progress:
            result = measure(load_scenario(scenario), steps, every, progress)
        rows = [
            (
                f"{row['solver']}: {row['phase']}",
                f"{row['median_us']:.1f}",
                f"{row['minimum_us']:.1f}",
                f"{row['p95_us']:.1f}",
                _verdict(row),
            )
            for row in result["rows"]
        ]
        header = ("per sample", "median µs", "minimum µs", "95 % µs", "ratio or target")
        out_.table(f"controllers on {result['scenario']}, {steps} samples", header, rows)
        out_.json(result)


@app.command()
def export(
    scenario: ScenarioOption = "paper",
    controller: Annotated[
        str, typer.Option("--controller", "-c", help="naive, tuned or a parameters file.")
    ] = "tuned",
    steps: Annotated[
        int, typer.Option("--steps", "-n", min=50, max=1_000_000, help="Samples of the run.")
    ] = 2000,
    json: JsonOption = False,
) -> None:
    """Time of a sample of the exported controller's FMU beside the Python controller's.

    Both act on each state of one closed loop; it also says how far their actions are apart.
    """
    with output(json) as out_:
        from cosim.cli.benchmark_export import measure
        from cosim.scenario import Scenario

        with out_.progress("samples", steps) as progress:
            result = measure(Scenario.load(scenario), controller, steps, progress)
        rows = [
            (row["name"], *(f"{row[key]:.1f}" for key in ("median_us", "minimum_us", "p95_us")))
            for row in result["rows"]
        ]
        header = ("a sample", "median µs", "minimum µs", "95 % µs")
        out_.table(f"{controller} on {result['scenario']}, {steps} samples", header, rows)
        met = "met" if result["met"] else "MISSED"
        out_.note(
            f"FMU {result['ratio']:.1f} times as fast; target {result['target_us']:g} µs: {met}"
        )
        out_.note(f"actions differ by {result['largest_difference']:.1e} at most")
        out_.json(result)


def _verdict(row: dict[str, Any]) -> str:
    """How a row stands to its target, or to what it is compared with."""
    if row["target_us"] is not None:
        return f"≤ {row['target_us']:g} µs: {'met' if row['met'] else 'MISSED'}"
    if row["ratio"] is None:
        return ""
    return f"{row['ratio']:.1f} × {row['ratio_to']}; {100 * row['solved_share']:.0f} % solved"


@app.command()
def learning(
    scenario: ScenarioOption = "paper",
    samples: Annotated[
        int,
        typer.Option("--samples", "-n", min=100, max=100_000_000, help="Samples per repetition."),
    ] = 2000,
    json: JsonOption = False,
) -> None:
    """Samples per second of each learning rule on one core, the FMU included."""
    with output(json) as out_:
        from cosim.cli.compose import load_scenario
        from learning.benchmark import measure

        result = measure(load_scenario(scenario), samples)
        rows = [
            (
                row["algorithm"],
                f"{row['median_samples_per_second']:.0f}",
                f"{row['lowest_samples_per_second']:.0f}",
                f"{row['highest_samples_per_second']:.0f}",
                ", ".join(f"{k} {v:.0f}" for k, v in row["microseconds_per_sample"].items()),
            )
            for row in result["rows"]
        ]
        header = ("samples per second", "median", "lowest", "highest", "µs per sample")
        out_.table(f"learning on {result['scenario']}, one core", header, rows)
        out_.json(result)


@app.command()
def scaling(
    scenario: ScenarioOption = "paper",
    horizons: Annotated[
        str, typer.Option("--horizons", help="Comma-separated horizons N, from 1 to 1000.")
    ] = "5,10,20,40",
    json: JsonOption = False,
) -> None:
    """Time of a sample's phases by horizon and θ, compiled, and the interpreter's ratio to it.

    CPU time. The first run compiles a library for each row, which takes seconds.
    """
    with output(json) as out_:
        from cosim.cli.benchmark_scaling import PHASES, measure
        from cosim.errors import CosimError
        from cosim.scenario import Scenario

        try:
            numbers = [int(part) for part in horizons.split(",")]
        except ValueError:
            numbers = []
        if not numbers or not all(1 <= number <= 1000 for number in numbers):
            raise CosimError(f"--horizons must be numbers from 1 to 1000, not '{horizons}'")
        with out_.progress("scaling", len(numbers) + 2) as progress:
            result = measure(Scenario.load(scenario), numbers, progress)
        rows = []
        for row in result["rows"]:
            mode, spent = list(row["microseconds"].items())[-1]
            cells = (f"{spent[phase]:.1f} ({row['ratios'][phase]:.1f})" for phase in PHASES)
            name = f"N = {row['horizon']}, θ {row['theta']} ({row['n_theta']}), {mode}"
            rows.append((name, f"{row['construction_s']:.2f}", *cells))
        header = ("µs of a sample (interpreter ×)", "construction s", *PHASES)
        out_.table(f"scaling on {result['scenario']}", header, rows)
        out_.json(result)
