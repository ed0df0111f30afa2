"""Options and answers of the commands that read logged data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import cosim
from cosim.cli import output as cli
from cosim.core.errors import CosimError
from cosim.core.training_options import PARAMETERS, TrainingOptions

if TYPE_CHECKING:
    from learning.configuration import Configuration

KNOWN = "known.png"
"""Figure of what the log says of the model."""
DataOption = Annotated[
    Path | None,
    typer.Option("--data", help="CSV file of logged data, in place of the plant."),
]
ColumnsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--column", help="With --data: NAME=COLUMN, a variable's column; may be repeated."
    ),
]
LeaveOutOption = Annotated[
    list[str] | None,
    typer.Option(
        "--leave-out", help="With --data: COLUMN=VALUE, rows to leave out; may be repeated."
    ),
]


def refuse(options: Mapping[str, object], reason: str) -> None:
    """Raise CosimError where one of these options is given.

    Args:
        options: values of options by name; false where an option is not given.
        reason: why it cannot be.
    """
    for name, value in options.items():
        if value:
            raise CosimError(f"--{name} {reason}")


def columns_by_name(texts: list[str] | None) -> dict[str, str]:
    """The columns of variables, from texts NAME=COLUMN; raises CosimError."""
    columns: dict[str, str] = {}
    from cosim.core.validation import assignments

    for name, column in assignments(texts or [], "--column", "NAME=COLUMN", CosimError):
        if name in columns:
            raise CosimError(f"--column {name} is given twice")
        columns[name] = column
    return columns


def train_from_data(
    algorithm: str,
    data: Path,
    scenario: str,
    settings: Configuration,
    options: TrainingOptions,
    columns: list[str] | None,
    leave_out: list[str] | None,
    folder: Path,
    output: cli.Output,
) -> None:
    """Learn θ from a log; write parameters.toml, known.png, summary.json and scenario.toml.

    Args:
        algorithm: `model-based` or `batch-q-learning`.
        data: the CSV file.
        scenario: a preset's name or a TOML file.
        settings: the hyperparameters.
        options: start, seed and controller of them count.
        columns: texts NAME=COLUMN.
        leave_out: texts COLUMN=VALUE.
        folder: of the files.
        output: where tables go.
    """
    from cosim.core.files import staged, write_atomically
    from cosim.core.run_files import RUN_FILES
    from cosim.figures.logged_data import known_figure
    from learning.from_data import train_from_data

    answer = train_from_data(
        algorithm,
        data,
        cosim.Scenario.load(scenario),
        start=options.start,
        seed=options.seed,
        controller=options.controller,
        settings=settings,
        columns=columns_by_name(columns),
        leave_out=leave_out or (),
    )
    summary = answer.summary()
    with staged(folder, RUN_FILES) as stage:
        answer.parameters.save(stage / PARAMETERS)
        write_atomically(stage / "scenario.toml", answer.run.scenario.to_toml())
        cli.write_summary(stage, summary)
        known_figure(summary).savefig(stage / KNOWN)
    show_use(summary, output)
    _show_answer(summary, output)
    output.json(summary)


def show_use(summary: dict[str, Any], output: cli.Output) -> None:
    """Print what of the log was used, and what was left out."""
    rows = [("rows of the file", str(summary["rows"]))]
    for reason, count in summary["left_out"].items():
        rows.append((f"left out: {reason}", str(count)))
    rows.append(("samples used", str(summary["transitions"])))
    output.table("logged data", ("what", "number"), rows)


def _show_answer(summary: dict[str, Any], output: cli.Output) -> None:
    """Print what the log says of θ, and what it does not say."""
    from cosim.core.statistics import shown

    rows = [("verdict", summary["verdict"])]
    for label, name in (
        ("J of the log", "J_logged"),
        ("J of the log, by the model", "J_logged_by_the_model"),
        ("J of the start, predicted", "J_of_the_start"),
        ("J of the learned θ, predicted", "J_of_the_learned_theta"),
    ):
        rows.append((label, shown(summary[name], digits=6)))
    for label, name in (
        ("learned θ less log", "against_logged"),
        ("learned θ less start", "against_start"),
        ("start less log", "start_against_logged"),
    ):
        rows.append((label, shown(summary[name], summary[f"{name}_interval"], 1, 3)))
    doubt = 100 * summary["share_of_variance_from_the_model"]
    outside = 100 * summary["share_of_samples_outside_the_log"]
    rows += [
        ("share of the doubt that is of the model, %", f"{doubt:.0f}"),
        ("samples of θ where the plant has not been, %", f"{outside:.0f}"),
        (
            "directions of the model that the log shows",
            f"{summary['directions_shown']} of {len(summary['directions'])}",
        ),
        (
            "moves of a bound of θ of which it tells if they cost more",
            f"{sum(move['is_told'] for move in summary['moves'])} of {len(summary['moves'])}",
        ),
    ]
    title = f"{summary['algorithm']} from logged data on {summary['scenario']}: {summary['status']}"
    output.table(title, ("per sample, 95 % intervals", "value"), rows)
    known = []
    for parameter in summary["parameters_known"]:
        known.append(
            (
                parameter["name"],
                f"{100 * parameter['change']:.1f}",
                f"{100 * parameter['deviation']:.1f}",
                f"{100 * max(parameter['shown'], 0.0):.0f}",
            )
        )
    header = ("parameter or disturbance", "error %", "± %", "shown by the log %")
    output.table("what the log says of the model", header, known)
    output.note(f"{KNOWN} draws this, and what the log does not show of model and θ")
    if summary["stage_cost_by_the_model"]:
        output.note("the file has no column stage_cost: the cost is the nominal model's")
    if summary["verdict"] == "better":
        output.note(f"{PARAMETERS} holds the learned θ")
        return
    output.note(f"cannot tell: {PARAMETERS} holds the start; {summary['experiment']}")
    interval = summary["start_against_logged_interval"]
    if interval is None:
        return
    if interval[1] < 0:
        output.note("the start itself is predicted to cost less than what was logged")
    elif interval[0] > 0:
        output.note(
            "the start is predicted to cost more than what was logged: leave in charge what is, or "
            "take another --start"
        )
