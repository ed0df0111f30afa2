"""`cosim train`: learn θ from plant samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import cosim
from cosim.cli import logged_data
from cosim.cli import output as cli
from cosim.core.training_options import TrainingOptions, option_ranges, with_training_options

if TYPE_CHECKING:
    from learning.configuration import Hyperparameter


def _as_option(name: str, kind: Any) -> Any:
    """Annotation of the command's option that is the field `name` of `TrainingOptions`."""
    limits = option_ranges().get(name)
    least = limits.least if limits else None
    most = limits.most if limits else None
    # None where Python drops docstrings (`python -OO`).
    text = cli.descriptions(TrainingOptions, "Attributes").get(name)
    return Annotated[kind, typer.Option(min=least, max=most, help=text)]


@with_training_options(_as_option)
def train(
    algorithm: Annotated[str, typer.Option("--algorithm", "-a")],
    scenario: cli.ScenarioOption = "paper",
    samples: Annotated[int | None, cli.count("--samples", "-n")] = None,
    data: logged_data.DataOption = None,
    columns: logged_data.ColumnsOption = None,
    leave_out: logged_data.LeaveOutOption = None,
    out: cli.OutOption = Path("cosim-train"),
    resume: Annotated[bool, typer.Option("--resume")] = False,
    overwrite: cli.OverwriteOption = False,
    assignments: Annotated[list[str] | None, typer.Option("--set")] = None,
    explain: Annotated[bool, typer.Option("--explain")] = False,
    gif: Annotated[bool, typer.Option("--gif")] = False,
    record: cli.RecordOption = False,
    json: cli.JsonOption = False,
    **options: Any,
) -> None:
    """Train a controller's θ; write parameters.toml, learning.csv, learning.png, summary.json.

    The learned θ is compared with its start on the same held-out noise. Exit code 1: θ is worse and
    parameters.toml holds the start, or learning diverged; the summary has the reason.

    With --data the rule learns from logged data and steps no plant. The answer is the predicted
    difference of J with its interval. If the log cannot tell, parameters.toml holds the start.

    Args:
        algorithm: Name of a rule, or module:Class.
        samples: Plant samples; default: the algorithm's, or 50 000.
        resume: Continue from the folder's checkpoint.
        assignments: Hyperparameter as NAME=VALUE; may be repeated.
        explain: List the algorithm's hyperparameters and stop.
        gif: Draw learning.gif too: the loop while θ is learned.
        options: Those of `TrainingOptions`, each an option of the command.
    """
    with cli.output(json) as out_:
        from controllers.factories import stored_optimum
        from cosim.core.files import staged
        from cosim.core.run_files import RUN_FILES
        from cosim.core.training_options import CHECKPOINT
        from learning.algorithm import load_algorithm
        from learning.training import run_training
        from learning.training_run import make_run
        from learning.verdict import NO_DIFFERENCE, WORSE

        # Neither a scenario nor a folder is needed to explain a rule.
        rule = load_algorithm(algorithm)
        if explain:
            _explain(algorithm, rule.Configuration.documentation(), out_)
            return
        if data is not None:
            of_a_plant = {"samples": samples, "resume": resume, "gif": gif, "record": record}
            logged_data.refuse(of_a_plant, "has no part in a training from --data")
            logged_data.train_from_data(
                algorithm,
                data,
                scenario,
                rule.Configuration.from_assignments(assignments or []),
                TrainingOptions(**options),
                columns,
                leave_out,
                cli.open_folder(out, overwrite),
                out_,
            )
            return
        logged_data.refuse({"column": columns, "leave-out": leave_out}, "belongs to --data")
        run = make_run(
            algorithm,
            cosim.Scenario.load(scenario),
            samples,
            rule.Configuration.from_assignments(assignments or []),
            TrainingOptions(**options),
        )
        # A training may have taken hours: it is replaced by an order alone.
        folder = cli.open_folder(
            out,
            resume or overwrite,
            "go on with it by --resume, start again by --overwrite",
        )
        out_.announce(run.scenario.plant.fmu)
        checkpoint = folder / CHECKPOINT

        def how() -> str:
            # An interruption may come before the first checkpoint.
            if not checkpoint.is_file():
                return ""
            return f"the same command with --resume goes on from {checkpoint}"

        with cli.resumable(how):
            best = stored_optimum(run.scenario)
            training = run_training(run, folder, resume=resume, optimum=best, progress=out_.live)
        if not training.run.evaluation_seeds:
            out_.note(
                "no held-out runs, so that nothing says whether θ became better; evaluate it, or "
                "give --evaluation-steps and --evaluation-seeds"
            )
        reason = training.without_checkpoint
        if reason:
            out_.note(f"left no checkpoint, --resume is not possible: {reason}")
        timing = {"wall_seconds": training.wall_seconds, "functions": training.functions}
        summary = training.summary() | {"timing": timing}
        # The checkpoint was written during the training, and stays.
        files_of_this_run = set(RUN_FILES) - {CHECKPOINT}
        with staged(folder, files_of_this_run) as stage:
            training.write_files(stage)
            if gif:
                training.animate(stage / "learning.gif")
            if record:
                from cosim.recording import record_training

                record_training(stage / "training.rrd", training)
            cli.write_summary(stage, summary)
        _show_training(summary, out_)
        if training.verdict == NO_DIFFERENCE:
            out_.note(
                f"no difference is shown by {run.evaluation_seeds} held-out runs: more narrow the "
                "interval, by --evaluation-seeds"
            )
        out_.note(f"the learning curve is {folder / 'learning.png'}")
        out_.json(summary)
    # All files are written before: a script that sees the code can read why.
    if training.status != "finished" or training.verdict == WORSE:
        raise typer.Exit(1)


def _explain(algorithm: str, hyperparameters: Sequence[Hyperparameter], output: cli.Output) -> None:
    """Print a rule's hyperparameters."""
    entries = []
    for name, default, allowed, meaning in hyperparameters:
        entries.append((f"{name} = {default}  ({allowed})", meaning))
    output.entries(f"hyperparameters of {algorithm}: name = default  (allowed)", entries)
    document = {}
    for hyperparameter in hyperparameters:
        words = hyperparameter._asdict()
        document[words.pop("name")] = words
    output.json(document)


def _or_none(value: float | None) -> str:
    """A figure of the summary, which a rule need not have."""
    return "none" if value is None else f"{value:.6g}"


def _show_training(summary: dict[str, Any], output: cli.Output) -> None:
    """Print what a training came to; what is not known of it is left out."""
    from cosim.core.statistics import shown

    form = "{algorithm} ({requires}) on {scenario}, {samples} samples, seed {seed}: {status}"
    title = form.format(**summary)
    rows = [("verdict", summary["verdict"])]
    if summary["reason"]:
        rows.append(("reason", summary["reason"]))
    if summary["evaluation_seeds"]:
        difference = shown(summary["difference"], summary["difference_interval"], 1, 3)
        rows += [
            ("J of the start, on held-out noise", shown(summary["start_J"], digits=6)),
            ("J of the learned θ, on the same", shown(summary["J"], digits=6)),
            ("difference", difference),
            ("economic cost of the learned θ", shown(summary["economic_cost"], digits=6)),
            ("mean violation of the learned θ", f"{summary['mean_violation']:.6f}"),
            ("violating share of the learned θ", f"{100 * summary['violating_share']:.2f} %"),
            ("failures of the learned θ", str(summary["failures"])),
        ]
    rows += [
        ("updates", str(summary["updates"])),
        ("changes of the plant detected", _or_none(summary["changes"])),
        ("retreats", str(summary["retreats"])),
        ("cost that the rule predicted", _or_none(summary["predicted_cost"])),
        ("cost since the last update", _or_none(summary["realised_cost"])),
        ("plant samples of the training", str(summary["plant_samples"])),
        ("plant samples of the held-out runs", str(summary["held_out_samples"])),
    ]
    # Both need an optimum of the scenario, which `cosim optimum` stores.
    if summary["regret"] is not None:
        regret = shown(summary["regret"], summary["regret_interval"], 100, 3)
        rows.append(("regret %", regret))
    if summary["gap_closed"] is not None:
        gap = shown(summary["gap_closed"], None, 100, 4)
        rows.append(("regret removed, %", gap))
    output.table(title, ("per sample", "value"), rows)
