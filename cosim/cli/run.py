"""One closed-loop run from names to files, shared by `demo` and `simulate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.cli.output import Output, dump, open_folder

if TYPE_CHECKING:
    from cosim.trajectory import Trajectory


@dataclass(frozen=True)
class Run:
    """What a run is made of, by name."""

    scenario: str
    controller: str
    steps: int
    seed: int
    out: Path
    record: bool


def execute(run: Run, output: Output) -> tuple[Trajectory, dict[str, Any]]:
    """Simulate, write trajectory.csv, timing.csv, summary.json, scenario.toml and run.rrd.

    Returns the trajectory and the summary. Everything that a clock measured is in timing.csv and
    the summary's `timing`; all other bytes are the same for the same command and seed.
    """
    from controllers import compile_functions
    from cosim.cli.compose import announce, load_scenario
    from cosim.files import write_atomically
    from cosim.plant import FmuPlant
    from cosim.plugins import build_controller
    from cosim.simulation import simulate

    scenario = load_scenario(run.scenario)
    folder = open_folder(run.out).absolute()  # an FMU may change the working directory
    announce(scenario, output)
    with FmuPlant(scenario) as plant:
        controller = build_controller(run.controller, scenario)
        compile_functions(controller, run.steps)
        recorder = None
        if run.record:
            from cosim.recording import RerunRecorder

            recorder = RerunRecorder(folder / "run.rrd")
        label = f"{run.controller} on {scenario.name}"
        with output.progress(label, run.steps) as progress:
            trajectory = simulate(
                plant, controller, run.steps, run.seed, recorder=recorder, progress=progress
            )
        summary = _summary(run, trajectory, controller, plant)
    if not run.record:
        # A recording that another run left would stand beside this one's signals.
        (folder / "run.rrd").unlink(missing_ok=True)
    trajectory.write_csv(folder / "trajectory.csv")
    trajectory.write_timing_csv(folder / "timing.csv")
    write_atomically(folder / "scenario.toml", scenario.to_toml())
    write_atomically(folder / "summary.json", dump(summary))
    return trajectory, summary


def _summary(run: Run, trajectory: Trajectory, controller: Any, plant: Any) -> dict[str, Any]:
    from importlib.metadata import version

    from cosim.protocols import functions_of

    parameters = getattr(controller, "parameters", None)
    return {
        "version": version("rti-cosim"),
        "scenario": trajectory.scenario.name,
        "scenario_hash": trajectory.scenario.hash,
        "fmu": plant.fmu_path.name,
        "fmu_sha256": plant.fmu_sha256,
        "controller": run.controller,
        "parameters_hash": getattr(parameters, "hash", None),
        "seed": run.seed,
        **trajectory.summary(),
        "timing": {**trajectory.timing_summary(), "functions": functions_of(controller)},
    }


def show(summary: dict[str, Any], output: Output) -> None:
    """Print a run's table: costs, violations, failures and step times."""
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
