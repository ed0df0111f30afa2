"""`cosim study`: cases × scenarios × training seeds from one file, and the report of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli.options import JobsOption, JsonOption, OutOption, SchedulerOption
from cosim.cli.output import Output, dump, open_folder, output, resumable

if TYPE_CHECKING:
    from cosim.studies.results import StudyResults
    from cosim.studies.run import State

app = typer.Typer(help="Run a study from a file, and report it.", no_args_is_help=True)

ColumnsOption = Annotated[
    str | None,
    typer.Option(
        "--columns",
        help="Columns of the printed tables, by comma, or `all`: case, samples, finished, regret, "
        "worst, iqm, J, J-worst, gap, economic, violation, violating.",
        show_default="case,regret,worst,finished,J",
    ),
]
FileArgument = Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)]


@app.command()
def run(
    file: FileArgument,
    out: OutOption = Path("cosim-study"),
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    columns: ColumnsOption = None,
    json: JsonOption = False,
) -> None:
    """Train and evaluate every case on every scenario with every training seed.

    Writes evaluation.csv, curves.csv, runs.csv, summary.csv, study.json, summary.json, timing.csv.
    Run again with the same --out to go on after an interruption, a failure or a change of the
    file: what is finished is not done again. Exit code 1: some runs failed, all others are done.
    """
    with output(json) as out_:
        results = execute(file, out, out_, jobs=jobs, scheduler=scheduler)
        summary = write_summary(results)
        show(results, out_, columns)
        out_.note(f"tables are in {out.resolve()}; cosim study report {out} draws them")
        out_.json(summary)


def execute(
    file: Path,
    out: Path,
    out_: Output,
    *,
    jobs: int | None,
    scheduler: str | None = None,
    figures: bool = True,
) -> StudyResults:
    """Run a study with a progress bar; exits with code 1 where runs failed."""
    from loky import cpu_count

    from cosim.errors import FailedRunsError
    from cosim.studies.plan import Study, plan
    from cosim.studies.run import study

    definition = Study.load(file)
    folder = open_folder(out)
    for scenario in definition.scenarios.values():
        out_.announce(scenario)
    planned = plan(definition)
    label, total = f"{definition.name}, thousands of samples", _thousands(planned.samples)
    with resumable(), out_.progress(label, total) as bar:

        def report(state: State, line: str) -> None:
            failed = f", {state.failed} failed" if state.failed else ""
            runs = f"{state.runs}/{state.all_runs} runs{failed}"
            bar(_thousands(state.samples), runs)
            if line:
                out_.note(f"{runs}  {line}")

        try:
            return study(
                definition,
                folder,
                jobs=jobs or cpu_count(),
                scheduler=scheduler,
                report=report,
                planned=planned,
                figures=figures,
            )
        except FailedRunsError as error:
            failure = error
    out_.note(f"failed: {failure}")
    raise typer.Exit(1)


@app.command("plan")
def show_plan(file: FileArgument, json: JsonOption = False) -> None:
    """Show what a study will do, and about how long: nothing is trained or written."""
    with output(json) as out_:
        from cosim.studies.estimate import estimate
        from cosim.studies.plan import Study, plan

        planned = plan(Study.load(file))
        rows = estimate(planned)
        seconds = float(rows.seconds.sum())
        rows["minutes"] = [f"{value / 60:.1f}" for value in rows.pop("seconds")]
        out_.table(
            f"{planned.definition.name}: {len(planned.runs)} runs, {planned.samples} plant samples",
            ("scenario", "case", "runs", "training samples", "evaluation samples", "CPU minutes"),
            rows.astype(str).to_numpy().tolist(),
        )
        out_.note(f"about {seconds / 3600:.2f} h of one core, as fast as this one is now")
        out_.json(
            {
                "runs": len(planned.runs),
                "samples": planned.samples,
                "timing": {"estimated_seconds": seconds},
            }
        )


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a study.", show_default=False)],
    columns: ColumnsOption = None,
    json: JsonOption = False,
) -> None:
    """Draw a study: report.html, one page that needs nothing else, report.md and figures/.

    A study that is not finished, or a stored one, is reported with what it has.
    """
    with output(json) as out_:
        from cosim.studies.results import StudyResults

        results = StudyResults.load(folder)
        page = results.report()
        show(results, out_, columns)
        out_.note(f"the report is {page.resolve()}")
        out_.json({"report": str(page), "runs": len(results.runs)})


def _thousands(samples: int) -> int:
    return round(samples / 1000)


def write_summary(results: StudyResults) -> dict[str, Any]:
    """Write summary.json and return what it says; `timing` is what timing.csv says of each run."""
    from cosim.files import write_atomically
    from cosim.studies.results import TIMING
    from cosim.studies.tables import read_table

    document = {
        **results.about,
        "summary": results.summary.to_dict("records"),
        "aggregate": results.aggregate.to_dict("records"),
        "timing": {
            row["run"]: {"training_seconds": float(row["training_seconds"])}
            for row in read_table(results.folder / TIMING, types={"run": str}).to_dict("records")
        },
    }
    write_atomically(results.folder / "summary.json", dump(document))
    return document


def show(results: StudyResults, out_: Output, columns: str | None = None) -> None:
    """Print a table for each scenario, with the columns that `--columns` names."""
    from cosim.studies.report import COLUMNS, SHORT

    chosen = COLUMNS if columns == "all" else columns.split(",") if columns else SHORT
    for scenario in results.scenarios:
        out_.table(f"{results.name}: {scenario}", *results.lines(scenario, tuple(chosen)))
