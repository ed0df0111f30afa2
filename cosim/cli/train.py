"""`cosim train`: learn θ from plant data."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from cosim.cli.options import JsonOption, OutOption, RecordOption, ScenarioOption
from cosim.cli.output import Output, dump, load_scenario, open_folder, output, resumable
from cosim.errors import CosimError

if TYPE_CHECKING:
    from learning.training import LogRow, Training

FILES = (
    "checkpoint.npz",
    "learning.csv",
    "learning.png",
    "parameters.toml",
    "summary.json",
    "training.rrd",
)
"""What a training leaves in its folder; each belongs to the same run."""
DEFAULTS = {"samples": None, "seed": 0}
"""Of fields of `TrainingRun` that have none."""
# Columns of the log behind the progress bar: name, text, scale, format.
FIGURES = (
    ("J", "J", 1, ".0f"),
    ("greedy_J", "greedy", 1, ".0f"),
    ("regret", "regret %", 100, ".3g"),
    ("td_error", "TD", 1, ".3g"),
    ("smallest_eigenvalue", "λmin", 1, ".2g"),
)


def train(
    algorithm: Annotated[
        str,
        typer.Option("--algorithm", "-a", help="A registered one or module:Class."),
    ],
    scenario: ScenarioOption = "paper",
    out: OutOption = Path("cosim-train"),
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
    optimum: Annotated[
        str | None,
        typer.Option(
            "--optimum",
            help="Controller whose J is J*; default: optimal, where its solution is stored.",
        ),
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="List the algorithm's hyperparameters and stop.")
    ] = False,
    record: RecordOption = False,
    json: JsonOption = False,
    **options: Any,
) -> None:
    """Train a controller's θ; write parameters.toml, learning.csv, learning.png, summary.json.

    Exit code 1: learning diverged; the files hold the θ that the run ended with and the summary
    says why.
    """
    with output(json) as out_:
        from cosim.files import write_atomically
        from learning.algorithm import load_algorithm
        from learning.training import CHECKPOINT, run_training, stored_optimum
        from learning.training_run import prepare

        found = load_algorithm(algorithm)
        if explain:
            rows = found.Configuration.documentation()
            out_.table(f"hyperparameters of {algorithm}", ("name", "default", "meaning"), rows)
            out_.json({name: {"default": given, "meaning": text} for name, given, text in rows})
            return
        settings = found.Configuration.from_assignments(assignments or [])
        samples = options.pop("samples")
        run = prepare(algorithm, load_scenario(scenario), samples, settings, options)
        folder = open_folder(out).absolute()
        there = [name for name in FILES if (folder / name).exists()]
        if there and not (resume or overwrite):
            raise CosimError(
                f"folder '{folder}' holds another training ({there[0]}); go on with it by "
                "--resume, begin anew by --overwrite, or choose another --out"
            )
        out_.announce(run.scenario)
        checkpoint = folder / CHECKPOINT

        def how() -> str:
            go_on = f"the same command with --resume goes on from {checkpoint}"
            return go_on if checkpoint.is_file() else ""

        with resumable(how), out_.progress(algorithm, run.samples) as progress:
            best = optimum or stored_optimum(run.scenario)
            training = run_training(
                run, folder, resume=resume, optimum=best, progress=remark(progress)
            )
        if reason := training.without_checkpoint:
            out_.note(f"left no checkpoint, --resume is not possible: {reason}")
        summary = training.summary()
        summary["timing"] = {
            "wall_seconds": training.wall_seconds,
            "functions": training.functions,
        }
        training.save(folder)
        write_atomically(folder / "summary.json", dump(summary))
        if record:
            record_training(folder / "training.rrd", training)
        if overwrite and not record:
            # Only now: had this run failed, the one before it would have been lost.
            (folder / "training.rrd").unlink(missing_ok=True)
        _show(summary, out_)
        out_.note(f"the learning curve is {folder / 'learning.png'}")
        out_.json(summary)
    if training.status != "finished":
        raise typer.Exit(1)


_SIGNATURE = inspect.signature(train, eval_str=True)
# What the list of all commands needs: without the options that `command` adds.
train.__signature__ = _SIGNATURE.replace(  # type: ignore[attr-defined]
    parameters=list(_SIGNATURE.parameters.values())[:-1]
)


def command() -> Any:
    """The command with an option for each further field of `TrainingRun`.

    Made only where it is asked for: the fields' module imports the whole of learning.
    """
    from learning.training_run import TrainingRun

    types = get_type_hints(TrainingRun)
    parameters = list(inspect.signature(train).parameters.values())
    for field in (field for field in fields(TrainingRun) if field.metadata):
        default, about = DEFAULTS.get(field.name, field.default), field.metadata
        kind: Any = types[field.name] | None if default is None else types[field.name]
        names = [f"--{field.name.replace('_', '-')}", *(["-n"] if field.name == "samples" else [])]
        bounds = {"min": about["least"], "max": about["most"]} if about["least"] is not None else {}
        option = typer.Option(*names, help=about["text"], **bounds)
        parameters.append(
            inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=default,
                annotation=Annotated[kind, option],
            )
        )

    def complete(**values: Any) -> None:
        train(**values)

    complete.__doc__ = train.__doc__
    complete.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    app = typer.Typer(add_completion=False)
    app.command("train")(complete)
    return typer.main.get_command(app)


def remark(progress: Callable[..., None]) -> Callable[[int, LogRow], None]:
    """Show J, TD error, regret and the smallest eigenvalue of the log's rows behind the bar."""
    last: dict[str, float] = {}

    def update(done: int, row: LogRow) -> None:
        last.update({name: value for name, value in row.items() if not isnan(value)})
        shown = [f"{t} {scale * last[n]:{form}}" for n, t, scale, form in FIGURES if n in last]
        progress(done, "  ".join(shown))

    return update


def record_training(path: Path, training: Training) -> None:
    """Write a Rerun recording of a training."""
    from cosim import recording

    run, blocks = training.run, training.parameters.blocks
    recording.record_training(
        path,
        f"{run.algorithm} on {run.scenario.name}",
        training.log(),
        training.theta(),
        {name: blocks.labels[where] for name, where in blocks.slices.items()},
        {
            "algorithm": run.algorithm,
            "scenario": run.scenario.name,
            "scenario_hash": run.scenario.hash,
            "samples": run.samples,
            "seed": run.seed,
            **run.configuration.model_dump(mode="json"),
        },
    )


def _show(summary: dict[str, Any], output: Output) -> None:
    from cosim.statistics import shown

    title = (
        "{algorithm} ({asks_for}) on {scenario}, {samples} samples, seed {seed}: {status}"
    ).format(**summary)
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
