"""`cosim study`, `results` and `reproduce`: studies from files, stored ones, the paper's."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import cosim
from cosim.cli import output as cli

app = typer.Typer(help="Run a study from a file, and report it.", no_args_is_help=True)
results = typer.Typer(help="Check the stored studies, or make them anew.", no_args_is_help=True)

FileArgument = Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)]
NamesArgument = Annotated[
    list[str] | None, typer.Argument(help="Studies; default: all that apply.")
]


@app.command()
def run(
    file: FileArgument,
    out: cli.OutOption = Path("cosim-study"),
    jobs: cli.JobsOption = None,
    scheduler: cli.SchedulerOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Train and evaluate every case on every scenario with every training seed.

    Writes evaluation.csv, curves.csv, runs.csv, summary.csv, study.json, summary.json, timing.csv.
    Run again with the same --out to go on after an interruption, a failure or a change of the
    file: what is finished is not done again. Exit code 1: some runs failed, all others are done.
    """
    with cli.output(json) as out_:
        found = _execute(file, out, out_, jobs=jobs, scheduler=scheduler)
        _show(found, out_)
        out_.note(f"tables are in {out.resolve()}; cosim study report {out} draws them")
        summary = _summary(found)
        cli.write_summary(found.folder, summary)
        out_.json(summary)


def _execute(
    file: Path,
    out: Path,
    out_: cli.Output,
    *,
    jobs: int | None,
    scheduler: str | None = None,
    figures: bool = True,
) -> cosim.StudyResults:
    """Run a study with a progress bar; exits with code 1 where runs failed."""
    from loky import cpu_count

    from cosim.core.errors import FailedRunsError
    from cosim.studies.plan import plan

    definition = cosim.Study.load(file)
    folder = cli.open_folder(out)
    for scenario in definition.scenarios.values():
        out_.announce(scenario.plant.fmu)
    planned = plan(definition)
    with cli.followed(out_, definition.name, planned.samples) as report:
        try:
            return cosim.study(
                definition,
                folder,
                jobs=jobs or cpu_count(),
                scheduler=scheduler,
                progress=report,
                planned=planned,
                figures=figures,
            )
        except FailedRunsError as error:
            out_.note(f"failed: {error}")
            raise typer.Exit(1) from None


@app.command("plan")
def show_plan(file: FileArgument, json: cli.JsonOption = False) -> None:
    """Show the runs of a study and the plant samples that they take: nothing is run or written."""
    with cli.output(json) as out_:
        import pandas as pd

        from cosim.studies.plan import plan

        planned = plan(cosim.Study.load(file))
        runs = pd.DataFrame(
            [(run.scenario.name, run.case, 1, run.samples) for run in planned.runs],
            columns=["scenario", "case", "runs", "plant samples"],
        )
        rows = runs.groupby(["scenario", "case"], sort=False, as_index=False).sum()
        out_.table(
            f"{planned.definition.name}: {len(planned.runs)} runs, {planned.samples} plant samples",
            tuple(rows),
            rows.astype(str).to_numpy().tolist(),
        )
        out_.json({"runs": len(planned.runs), "samples": planned.samples})


@app.command()
def report(
    folder: Path,
    columns: str | None = None,
    json: cli.JsonOption = False,
) -> None:
    """Draw a study: report.html, one page that needs nothing else, report.md and figures/.

    Of an unfinished study the finished runs are reported. A stored study may be reported, too;
    `cosim results draw` draws the figures of its single runs before.

    Args:
        folder: Folder of a study.
        columns: Columns of the printed tables, by comma, or `all`: case, rank, samples, finished,
            regret, worst, iqm, J, J-worst, gap, economic, violation, violating, against,
            difference, p; default: case,rank,regret,worst,finished.
    """
    with cli.output(json) as out_:
        found = cosim.StudyResults.load(folder)
        page = found.report()
        _show(found, out_, columns)
        out_.note(f"the report is {page.resolve()}")
        out_.json({"report": str(page), "runs": len(found.runs)})


def _summary(found: cosim.StudyResults) -> dict[str, Any]:
    """The study as a JSON document; `timing` is timing.csv by run."""
    from cosim.evaluation import TIMING
    from cosim.studies.run import read_table

    timing = read_table(found.folder / TIMING, needed=["run"])
    return {
        **found.about,
        "summary": found.summary.to_dict("records"),
        "aggregate": found.aggregate.to_dict("records"),
        "timing": timing.set_index("run").to_dict("index"),
    }


def _show(found: cosim.StudyResults, out_: cli.Output, columns: str | None = None) -> None:
    """Print a table for each scenario, with the columns that `--columns` names."""
    from cosim.studies.report import COLUMNS, SHORT

    chosen = COLUMNS if columns == "all" else columns.split(",") if columns else SHORT
    for scenario in found.scenarios:
        out_.table(f"{found.name}: {scenario}", *found.lines(scenario, tuple(chosen)))


def reproduce(
    budget: Literal["quick", "full"] = "quick",
    out: cli.OutOption = Path("cosim-reproduction"),
    jobs: cli.JobsOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Train the paper's rule and ours, and compare with (a) naive, (b) tuned and the optimum.

    A study (results/reproduce.toml, results/reproduce-full.toml): writes report.html and report.md
    with the paper's comparison at each reading of its open points and the paper's figure, and the
    tables of `cosim study run`. Run again with the same --out to go on after an interruption.

    Args:
        budget: quick: minutes on 2 cores; full: hours, with more seeds and samples.
    """
    with cli.output(json) as out_:
        from cosim.studies.stored import stored_results

        name = "reproduce" if budget == "quick" else "reproduce-full"
        found = _execute(stored_results() / f"{name}.toml", out, out_, jobs=jobs)
        page = found.report()
        _show(found, out_)
        out_.table(*found.paper())
        out_.note(f"the report is {page.resolve()}")
        summary = _summary(found)
        cli.write_summary(found.folder, summary)
        out_.json(summary)


@results.command()
def check(
    names: NamesArgument = None,
    folder: Annotated[Path | None, typer.Option("--results")] = None,
    jobs: cli.JobsOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Run the studies again that say `check = true`, and compare with the stored tables.

    Exit code 1 where a signal differs by more than its tolerance, with the first row that differs;
    2 where a stored table is missing or damaged. Writes nothing.

    Args:
        folder: Folder with the studies and tolerances.toml; default: ./results, else the installed
            ones.
    """
    with cli.output(json) as out_:
        from cosim.core.files import temporary_folder
        from cosim.studies import stored

        local = Path("results")
        folder = folder or (local if local.is_dir() else stored.stored_results())
        studies, tolerances = stored.stored_studies(folder), stored.load_tolerances(folder)
        checked = [name for name, table in studies.items() if table.check]
        quick = stored.chosen(studies, names or checked)
        for name in quick:
            cosim.StudyResults.load(folder / name)
            stored.compared_tables(folder / name)  # an unknown table is refused before the work
        found: dict[str, list[str]] = {}
        with temporary_folder("cosim-results-") as work:
            for name in quick:
                _execute(folder / f"{name}.toml", work / name, out_, jobs=jobs, figures=False)
                found[name] = stored.differences(name, folder / name, work / name, tolerances)
        verdicts = {name: "differs" if lines else "same" for name, lines in found.items()}
        rows = [(name, verdicts.get(name, "not recomputed")) for name in studies]
        out_.table("stored studies", ("study", "verdict"), rows)
        for line in chain(*found.values()):
            out_.note(line)
        out_.json({"same": not any(found.values()), "differences": found})
    if any(found.values()):
        raise typer.Exit(1)


@results.command()
def update(
    names: NamesArgument = None,
    folder: Annotated[Path, typer.Option("--results")] = Path("results"),
    jobs: cli.JobsOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Run studies and store their tables and reports, and the folder's README.

    What long studies have finished is kept in the folder's `.work`; run again to go on.

    Args:
        folder: Folder with the studies and tolerances.toml.
    """
    with cli.output(json) as out_:
        from cosim.studies import stored

        studies = stored.stored_studies(folder)
        for name in stored.chosen(studies, names or list(studies)):
            out = folder / stored.WORK / name
            _execute(folder / f"{name}.toml", out, out_, jobs=jobs).report()
            for table in stored.store(folder, name, out):
                out_.note(f"{name}: {table} is too large to be stored")
        stored.write_readme(folder, studies)
        out_.note(f"stored {', '.join(names or studies)} in {folder.resolve()}")
        out_.json({"updated": list(names or studies)})


@results.command()
def draw(
    names: NamesArgument = None,
    folder: Annotated[Path, typer.Option("--results")] = Path("results"),
    json: cli.JsonOption = False,
) -> None:
    """Draw the figures of stored studies from their tables, as NAME/figures/*.svg.

    Figures are not stored. `make docs` draws all of them for the site, some minutes.

    Args:
        folder: Folder with the studies and tolerances.toml.
    """
    with cli.output(json) as out_:
        from cosim.studies import stored

        studies = stored.stored_studies(folder)
        kept = [name for name in studies if (folder / name).is_dir()]
        drawn = {}
        for name in stored.chosen(studies, names or kept):
            drawn[name] = stored.draw(folder, name)
            out_.note(f"{name}: {len(drawn[name])} figures in {folder / name / 'figures'}")
        out_.json({"figures": drawn})
