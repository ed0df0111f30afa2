"""The commands of `cosim benchmark`: what they ask for, and what they print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options import JsonOption, ScenarioOption, count
from cosim.cli.output import output

app = typer.Typer(no_args_is_help=True)


@app.callback()
def benchmark() -> None:
    """Measure speed: each figure in µs beside a reference from the same run.

    Times are CPU time, but for `evaluation`; a ratio says how many times as long the reference
    takes.
    """


@app.command()
def plant(
    scenario: ScenarioOption = "paper",
    fmu: Annotated[
        str | None, typer.Option("--fmu", help="FMU in place of the scenario's, name or path.")
    ] = None,
    steps: Annotated[int, count("--steps", least=100, text="Steps per repetition.")] = 5000,
    json: JsonOption = False,
) -> None:
    """Time per plant step against fmpy's convenience methods and simulate_fmu.

    A step sets the inputs, reads stage cost and disturbances, steps, and reads the states.
    """
    with output(json) as out_:
        from cosim.cli.benchmark.figures import show
        from cosim.cli.benchmark.plant import measure

        result = measure(scenario, fmu, steps)
        show(f"plant {result['fmu']}, {steps} steps a repetition", result["rows"], out_)
        out_.json(result)


@app.command()
def evaluation(
    scenario: ScenarioOption = "paper",
    controllers: Annotated[
        str, typer.Option("--controllers", "-c", help="Comma-separated, as for evaluate.")
    ] = "naive",
    seeds: Annotated[int, count("--seeds", most=1_000_000, text="Number of seeds.")] = 100,
    steps: Annotated[int, count("--steps", "-n", text="Samples per run.")] = 2000,
    jobs: Annotated[int, count("--jobs", "-j", least=2, most=1024, text="Workers to compare.")] = 2,
    json: JsonOption = False,
) -> None:
    """Time of an evaluation by several workers against one, starting them included."""
    with output(json) as out_:
        from functools import partial

        from cosim.cli.benchmark.evaluation import measure
        from cosim.cli.compose import load_scenario
        from cosim.cli.evaluate import named_controllers
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
        out_.note(f"speed-up {result['timing']['speed_up']:.2f}, least times")
        out_.note("same bytes" if result["same_bytes"] else "the bytes DIFFER")
        out_.json(result)
    if not result["same_bytes"]:
        raise typer.Exit(1)


@app.command()
def controllers(
    scenario: ScenarioOption = "paper",
    steps: Annotated[
        int, count("--steps", "-n", least=50, most=1_000_000, text="Samples of each run.")
    ] = 2000,
    every: Annotated[
        int, count("--every", most=1_000_000, text="Compare every so many samples with the others.")
    ] = 10,
    json: JsonOption = False,
) -> None:
    """Time of each phase of an RTI-NMPC's sample along a closed loop.

    References: the same functions interpreted, ProxQP in place of DAQP; ProxQP called cold through
    qpsolvers on the same QPs, IPOPT on the nonlinear programme, and a Q-learning sample of mpcrl on
    the same transitions, where that is installed (extra `outsiders`).
    """
    with output(json) as out_:
        from cosim.cli.benchmark.controllers import measure
        from cosim.cli.benchmark.figures import show
        from cosim.cli.compose import load_scenario

        with out_.progress("controllers", steps) as progress:
            result = measure(load_scenario(scenario), steps, every, progress)
        title = f"controllers on {result['scenario']}, {steps} samples, {result['functions']}"
        show(title, result["rows"], out_)
        for name in result["missing"]:
            out_.note(f"not installed: {name}")
        out_.json(result)


@app.command()
def export(
    scenario: ScenarioOption = "paper",
    controller: Annotated[
        str, typer.Option("--controller", "-c", help="naive, tuned or a parameters file.")
    ] = "tuned",
    steps: Annotated[
        int, count("--steps", "-n", least=50, most=1_000_000, text="Samples of the run.")
    ] = 2000,
    json: JsonOption = False,
) -> None:
    """Time of a sample of the exported controller's FMU beside the Python controller's.

    Both act on each state of one closed loop; it also says how far their actions are apart.
    """
    with output(json) as out_:
        from cosim.cli.benchmark.export import measure
        from cosim.cli.benchmark.figures import show
        from cosim.scenario import Scenario

        with out_.progress("samples", steps) as progress:
            result = measure(Scenario.load(scenario), controller, steps, progress)
        show(f"{controller} on {result['scenario']}, {steps} samples", result["rows"], out_)
        out_.note(f"actions differ by {result['largest_difference']:.1e} at most")
        out_.json(result)


@app.command()
def learning(
    scenario: ScenarioOption = "paper",
    samples: Annotated[
        int, count("--samples", "-n", least=100, text="Samples per repetition.")
    ] = 1000,
    against: Annotated[
        Path | None,
        typer.Option(
            "--against", help="Folder with another version's sources, such as a git worktree."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Time of a sample of each learning rule on one core, the FMU included.

    References: the same with interpreted functions and, with --against, the same rule in another
    version, each in a process of its own and in turn. Rules alone, as all versions have them, come
    first, then the recommended ones.
    """
    with output(json) as out_:
        from cosim.cli.benchmark.figures import show
        from cosim.cli.benchmark.learning import CASES, measure
        from cosim.cli.compose import load_scenario

        load_scenario(scenario)
        with out_.progress("rules", len(CASES)) as progress:
            result = measure(scenario, samples, progress, against=against)
        title = f"learning on {result['scenario']}, one core, functions {result['functions']}"
        show(title, result["rows"], out_)
        parts = [
            (name, *(f"{value:.1f}" for value in row.values()))
            for name, row in result["parts"].items()
        ]
        out_.table("µs of a sample by part", ("rule", *next(iter(result["parts"].values()))), parts)
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
        from cosim.cli.benchmark.scaling import PHASES, measure
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
