"""`cosim train`: learn θ from plant data."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli.output import JsonOption, Output, Progressing, dump, open_folder, output
from cosim.cli.simulate import ScenarioOption

if TYPE_CHECKING:
    from learning.log import LogRow
    from learning.training_run import TrainingResult, TrainingRun

FILES = ("checkpoint.npz", "learning.csv", "parameters.toml", "summary.json", "training.rrd")
"""What a training leaves in its folder; each belongs to the same run."""
# Columns of the log behind the progress bar: name, text, scale, format.
FIGURES = (
    ("J", "J", 1, ".0f"),
    ("greedy_J", "greedy", 1, ".0f"),
    ("regret", "regret %", 100, ".3g"),
    ("td_error", "TD", 1, ".3g"),
    ("smallest_eigenvalue", "λmin", 1, ".2g"),
)

AlgorithmOption = Annotated[
    str,
    typer.Option(
        "--algorithm",
        "-a",
        help="actor-critic, batch-q-learning, q-learning; backoff, offset-free, identified, "
        "policy-search; another registered one or module:Class.",
    ),
]


def train(
    algorithm: AlgorithmOption,
    scenario: ScenarioOption = "paper",
    samples: Annotated[
        int | None,
        typer.Option(
            "--samples",
            "-n",
            min=1,
            max=100_000_000,
            help="Plant samples; default: 50 000, or what the algorithm says.",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=999_999, help="Seed of noise and exploration.")
    ] = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path(
        "cosim-train"
    ),
    resume: Annotated[
        bool,
        typer.Option(
            "--resume", help="Go on from the folder's checkpoint, to more --samples if you like."
        ),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Begin anew where the folder holds another run.")
    ] = False,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", help="Hyperparameter as name=value; may be repeated."),
    ] = None,
    start: Annotated[
        str, typer.Option("--start", help="Where θ starts: naive, tuned or a parameters file.")
    ] = "naive",
    validate_every: Annotated[
        int,
        typer.Option(
            "--validate-every",
            min=0,
            max=100_000_000,
            help="Samples per validation run, which chooses among θ; 0: none.",
        ),
    ] = 0,
    validation_samples: Annotated[
        int,
        typer.Option(
            "--validation-samples",
            min=1,
            max=100_000_000,
            help="Samples of each validation run; they count as plant samples.",
        ),
    ] = 1000,
    controller: Annotated[
        str, typer.Option("--controller", help="What carries θ: rti or converged.")
    ] = "rti",
    optimum: Annotated[
        str | None,
        typer.Option(
            "--optimum",
            help="Controller whose J is J*; default: optimal, where its solution is stored.",
        ),
    ] = None,
    log_every: Annotated[
        int, typer.Option("--log-every", min=1, max=100_000_000, help="Samples per row.")
    ] = 1000,
    evaluate_every: Annotated[
        int,
        typer.Option(
            "--evaluate-every", min=1, max=100_000_000, help="Samples per greedy evaluation."
        ),
    ] = 5000,
    checkpoint_every: Annotated[
        int,
        typer.Option("--checkpoint-every", min=1, max=100_000_000, help="Samples per checkpoint."),
    ] = 5000,
    evaluation_seeds: Annotated[
        int,
        typer.Option(
            "--evaluation-seeds", min=1, max=1_000_000, help="Held-out runs per evaluation."
        ),
    ] = 4,
    evaluation_steps: Annotated[
        int,
        typer.Option("--evaluation-steps", min=1, max=100_000_000, help="Samples of each of them."),
    ] = 500,
    explain: Annotated[
        bool, typer.Option("--explain", help="List the algorithm's hyperparameters and stop.")
    ] = False,
    record: Annotated[bool, typer.Option("--record", help="Write a Rerun recording too.")] = False,
    json: JsonOption = False,
) -> None:
    """Train a controller's θ and write parameters.toml, learning.csv and summary.json.

    Exit code 1: learning diverged; the files hold the run's own last θ and the summary says why.
    """
    with output(json) as out_:
        from cosim.lookup import import_from_here
        from cosim.scenario import Scenario
        from learning.registry import load_algorithm
        from learning.training_run import TrainingRun

        import_from_here()
        found = load_algorithm(algorithm)
        if explain:
            _explain(algorithm, found.Configuration.documentation(), out_)
            return
        run = TrainingRun(
            algorithm=algorithm,
            scenario=Scenario.load(scenario),
            samples=getattr(found, "budget", 50_000) if samples is None else samples,
            seed=seed,
            configuration=found.Configuration.from_assignments(assignments or []),
            controller=controller,
            log_every=log_every,
            evaluate_every=evaluate_every,
            checkpoint_every=checkpoint_every,
            evaluation_seeds=evaluation_seeds,
            evaluation_steps=evaluation_steps,
            start=start,
            validate_every=validate_every,
            validation_samples=validation_samples,
        )
        folder = open_folder(out).absolute()
        if not (resume or overwrite):
            _require_no_run(folder)
        begin = time.perf_counter()
        result = _execute(run, found, folder, optimum, resume, record, out_)
        summary = summarise(run, result)
        summary["timing"] = {
            "wall_seconds": time.perf_counter() - begin,
            "functions": result.functions,
        }
        _write(folder, run, result, summary)
        if overwrite and not record:
            # Only now: had this run failed, the one before it would have been lost.
            (folder / "training.rrd").unlink(missing_ok=True)
        _show(summary, out_)
        out_.json(summary)
    if result.status != "finished":
        raise typer.Exit(1)


def _require_no_run(folder: Path) -> None:
    from cosim.errors import CosimError

    if found := [name for name in FILES if (folder / name).exists()]:
        raise CosimError(
            f"folder '{folder}' holds another training ({found[0]}); go on with it by --resume, "
            "begin anew by --overwrite, or choose another --out"
        )


def _execute(
    run: TrainingRun,
    algorithm: Any,
    folder: Path,
    optimum: str | None,
    resume: bool,
    record: bool,
    output: Output,
) -> TrainingResult:
    from cosim.cli.compose import build_plant
    from cosim.lookup import build_controller
    from learning.optimum import has_stored_optimum
    from learning.training_loop import TrainingLoop

    if optimum is None and has_stored_optimum(run.scenario):
        optimum = "optimal"

    recorder: Any = None
    if record:
        from cosim.recording import TrainingRecorder

        recorder = TrainingRecorder(folder / "training.rrd")
    with (
        build_plant(run.scenario, output) as plant,
        build_plant(run.scenario) as evaluation_plant,
        output.progress(run.algorithm, run.samples) as progress,
    ):
        training = TrainingLoop(
            run,
            algorithm,
            plant,
            evaluation_plant,
            optimum=build_controller(optimum, run.scenario) if optimum else None,
            out=folder,
            recorder=recorder,
        )
        result = training.go(resume=resume, progress=_remark(progress))
    if training.without_checkpoint:
        output.note(f"left no checkpoint, --resume is not possible: {training.without_checkpoint}")
    return result


def _remark(progress: Progressing) -> Callable[[int, LogRow | None], None]:
    """Show J, TD error, regret and the smallest eigenvalue of the log's rows behind the bar."""
    last: dict[str, float] = {}

    def update(done: int, row: LogRow | None) -> None:
        if row is None:
            return
        last.update({name: value for name, value in row.items() if not isnan(value)})
        figures = [
            f"{text} {scale * last[name]:{form}}"
            for name, text, scale, form in FIGURES
            if name in last
        ]
        progress(done, "  ".join(figures))

    return update


def summarise(run: TrainingRun, result: TrainingResult) -> dict[str, Any]:
    """What `summary.json` says of a run, but for its timing."""
    from importlib.metadata import version

    last: Mapping[str, float] = result.rows[-1] if result.rows else {}
    return {
        "version": version("rti-cosim"),
        "algorithm": run.algorithm,
        "scenario": run.scenario.name,
        "scenario_hash": run.scenario.hash,
        "controller": run.controller,
        "start": run.start,
        "samples": int(last.get("samples", 0)),
        "plant_samples": result.plant_samples,
        "validation": _validation(run, result),
        "seed": run.seed,
        "status": result.status,
        "hyperparameters": run.configuration.model_dump(mode="json"),
        "parameters_hash": result.parameters.hash,
        "evaluation_seeds": run.evaluation_seeds,
        "evaluation_steps": run.evaluation_steps,
        **result.evaluation,
        "smallest_eigenvalue": last.get("smallest_eigenvalue"),
        "td_error": last.get("td_error"),
        "late_movement": result.late_movement,
        "training_failures": last.get("failures"),
        "weakly_active": last.get("weakly_active"),
        "licq_failed": last.get("licq_failed"),
    }


def _validation(run: TrainingRun, result: TrainingResult) -> dict[str, int] | None:
    """How θ was chosen among those of the run, None where it is simply the last one."""
    if not run.validate_every:
        return None
    return {
        "validate_every": run.validate_every,
        "validation_samples": run.validation_samples,
        "samples": result.validated,
        "accepted": int(result.rows[-1]["accepted"]) if result.rows else 0,
    }


def _write(folder: Path, run: TrainingRun, result: TrainingResult, summary: dict[str, Any]) -> None:
    from learning.log import to_csv
    from rti_storage import write_atomically

    write_atomically(folder / "learning.csv", to_csv(result.rows))
    result.parameters.save(folder / "parameters.toml")
    write_atomically(folder / "scenario.toml", run.scenario.to_toml())
    write_atomically(folder / "summary.json", dump(summary))


def _show(summary: dict[str, Any], output: Output) -> None:
    from cosim.evaluation.statistics import shown

    title = "{algorithm} on {scenario}, {samples} samples, seed {seed}: {status}".format(**summary)
    regret, gap = summary["regret"], summary["gap_closed"]
    rows = [
        ("greedy J on held-out noise", shown(summary["J"], digits=6)),
        ("economic cost", shown(summary["economic_cost"], digits=6)),
        ("mean violation", f"{summary['mean_violation']:.6f}"),
        ("violating share", f"{100 * summary['violating_share']:.2f} %"),
        ("failures", str(summary["failures"])),
        ("plant samples", str(summary["plant_samples"])),
    ]
    if regret is not None:
        rows.append(("regret %", shown(regret, summary["regret_interval"], 100, 3)))
        rows.append(("gap closed %", shown(gap, None, 100, 4)))
    output.table(title, ("per sample", "value"), rows)


def _explain(algorithm: str, documentation: list[tuple[str, str, str]], output: Output) -> None:
    output.table(f"hyperparameters of {algorithm}", ("name", "default", "meaning"), documentation)
    output.json(
        {name: {"default": default, "meaning": text} for name, default, text in documentation}
    )
