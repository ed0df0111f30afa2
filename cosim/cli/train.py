"""`cosim train`: learn θ from plant data."""

from __future__ import annotations

from collections.abc import Callable
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli.options import JsonOption, OutOption, RecordOption, ScenarioOption, count
from cosim.cli.output import Output, Progressing, dump, open_folder, output, resumable

if TYPE_CHECKING:
    from learning.log import LogRow
    from learning.training import Training
    from learning.training_run import TrainingRun

FILES = (
    "checkpoint.npz",
    "learning.csv",
    "learning.png",
    "parameters.toml",
    "summary.json",
    "training.rrd",
)
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
        count(
            "--samples", "-n", text="Plant samples; default: 50 000, or what the algorithm says."
        ),
    ] = None,
    seed: Annotated[
        int, count("--seed", least=0, most=999_999, text="Seed of noise and exploration.")
    ] = 0,
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
    start: Annotated[
        str, typer.Option("--start", help="Where θ starts: naive, tuned or a parameters file.")
    ] = "naive",
    validate_every: Annotated[
        int,
        count(
            "--validate-every",
            least=0,
            text="Samples per validation run, which chooses among θ; 0: none.",
        ),
    ] = 0,
    validation_samples: Annotated[
        int,
        count(
            "--validation-samples",
            text="Samples of each validation run; they count as plant samples.",
        ),
    ] = 1000,
    rest_after: Annotated[
        int | None,
        count(
            "--rest-after", text="Samples after which θ stays and nothing explores; default: never."
        ),
    ] = None,
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
    log_every: Annotated[int, count("--log-every", text="Samples per row.")] = 1000,
    evaluate_every: Annotated[
        int, count("--evaluate-every", text="Samples per greedy evaluation.")
    ] = 5000,
    checkpoint_every: Annotated[
        int, count("--checkpoint-every", text="Samples per checkpoint.")
    ] = 5000,
    evaluation_seeds: Annotated[
        int, count("--evaluation-seeds", most=1_000_000, text="Held-out runs per evaluation.")
    ] = 4,
    evaluation_steps: Annotated[
        int, count("--evaluation-steps", text="Samples of each of them.")
    ] = 500,
    explain: Annotated[
        bool, typer.Option("--explain", help="List the algorithm's hyperparameters and stop.")
    ] = False,
    record: RecordOption = False,
    json: JsonOption = False,
) -> None:
    """Train a controller's θ; write parameters.toml, learning.csv, learning.png, summary.json.

    Exit code 1: learning diverged; the files hold the run's own last θ and the summary says why.
    """
    with output(json) as out_:
        from cosim.lookup import import_from_here
        from cosim.scenario import Scenario
        from learning.registry import load_algorithm
        from learning.training_run import prepare

        import_from_here()
        found = load_algorithm(algorithm)
        if explain:
            _explain(algorithm, found.Configuration.documentation(), out_)
            return
        run = prepare(
            algorithm,
            Scenario.load(scenario),
            samples,
            found.Configuration.from_assignments(assignments or []),
            {
                "seed": seed,
                "controller": controller,
                "log_every": log_every,
                "evaluate_every": evaluate_every,
                "checkpoint_every": checkpoint_every,
                "evaluation_seeds": evaluation_seeds,
                "evaluation_steps": evaluation_steps,
                "start": start,
                "validate_every": validate_every,
                "validation_samples": validation_samples,
                "rest_after": rest_after,
            },
        )
        folder = open_folder(out).absolute()
        if not (resume or overwrite):
            _require_no_run(folder)
        training = _execute(run, folder, optimum, resume, record, out_)
        summary = training.summary()
        summary["timing"] = {
            "wall_seconds": training.wall_seconds,
            "functions": training.result.functions,
        }
        _write(folder, training, summary)
        if overwrite and not record:
            # Only now: had this run failed, the one before it would have been lost.
            (folder / "training.rrd").unlink(missing_ok=True)
        _show(summary, out_)
        out_.note(f"the learning curve is {folder / 'learning.png'}")
        out_.json(summary)
    if training.status != "finished":
        raise typer.Exit(1)


def _require_no_run(folder: Path) -> None:
    from cosim.errors import CosimError

    if found := [name for name in FILES if (folder / name).exists()]:
        raise CosimError(
            f"folder '{folder}' holds another training ({found[0]}); go on with it by --resume, "
            "begin anew by --overwrite, or choose another --out"
        )


def _execute(
    run: TrainingRun, folder: Path, optimum: str | None, resume: bool, record: bool, output: Output
) -> Training:
    from cosim.cli.compose import announce
    from learning.training import carry_out
    from learning.training_loop import CHECKPOINT

    announce(run.scenario, output)
    checkpoint = folder / CHECKPOINT

    def how() -> str:
        there = f"the same command with --resume goes on from {checkpoint}"
        return there if checkpoint.is_file() else ""

    with resumable(how), output.progress(run.algorithm, run.samples) as progress:
        training = carry_out(
            run,
            out=folder,
            resume=resume,
            optimum=optimum,
            progress=_remark(progress),
        )
    if record:
        record_training(folder / "training.rrd", training)
    if reason := training.result.without_checkpoint:
        output.note(f"left no checkpoint, --resume is not possible: {reason}")
    return training


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


def _write(folder: Path, training: Training, summary: dict[str, Any]) -> None:
    from cosim.files import write_atomically

    training.save(folder)
    write_atomically(folder / "summary.json", dump(summary))


def _show(summary: dict[str, Any], output: Output) -> None:
    from cosim.statistics import shown

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
