"""`cosim study`, `results` and `reproduce`: studies from files, stored ones, the paper's."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import cosim
from cosim.cli import output as cli

study_app = typer.Typer(help="Run a study from a file, and report it.", no_args_is_help=True)
results_app = typer.Typer(help="Check the stored studies, or update them.", no_args_is_help=True)

StudyFileArgument = Annotated[Path, typer.Argument(show_default=False)]
NamesArgument = Annotated[
    list[str] | None, typer.Argument(help="Studies; default: all that apply.")
]


@study_app.command("run")
def run_study(
    file: StudyFileArgument,
    out: cli.OutOption = Path("cosim-study"),
    jobs: cli.JobsOption = None,
    scheduler: cli.SchedulerOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Train and evaluate every case on every scenario with every training seed.

    Writes evaluation.csv, curves.csv, runs.csv, summary.csv, study.json, summary.json, timing.csv.
    After an interruption, a failure or a change of the file, run again with the same --out:
    finished runs are kept. Exit code 1: some runs failed; all others are done.

    Args:
        file: Study file (TOML).
    """
    with cli.output(json) as out_:
        results = _execute(file, out, out_, jobs=jobs, scheduler=scheduler)
        _show_tables(results, out_)
        out_.note(f"tables are in {out.resolve()}; cosim study report {out} draws them")
        summary = _summary(results)
        cli.write_summary(results.folder, summary)
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
    folder = cli.open_study_folder(out)
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
        # The other runs are done and stored: the same command tries these once more.
        except FailedRunsError as error:
            out_.note(f"failed: {error}")
            raise typer.Exit(1) from None


@study_app.command("plan")
def show_plan(file: StudyFileArgument, json: cli.JsonOption = False) -> None:
    """Show the runs of a study and their plant samples; nothing is run or written.

    Args:
        file: Study file (TOML).
    """
    with cli.output(json) as out_:
        from cosim.studies.plan import plan

        planned = plan(cosim.Study.load(file))
        n_runs = len(planned.runs)
        # In the order of the study's file, as its reports have it: a dictionary keeps it.
        runs_of: dict[tuple[str, str], int] = Counter()
        samples_of: dict[tuple[str, str], int] = Counter()
        for run in planned.runs:
            key = (run.scenario.name, run.case)
            runs_of[key] += 1
            samples_of[key] += run.samples
        rows = []
        for key, count in runs_of.items():
            rows.append((*key, str(count), str(samples_of[key])))
        title = f"{planned.definition.name}: {n_runs} runs, {planned.samples} plant samples"
        header = ("scenario", "case", "runs", "plant samples")
        out_.table(title, header, rows)
        out_.json({"runs": n_runs, "samples": planned.samples})


@study_app.command("report")
def report_study(
    folder: Path,
    columns: str | None = None,
    json: cli.JsonOption = False,
) -> None:
    """Write a study's report: report.html as one self-contained page, report.md and figures/.

    An unfinished study is reported by its finished runs. For a stored study use
    `cosim results draw` first: it draws the figures of single runs.

    Args:
        folder: Folder of a study.
        columns: Columns of the printed tables, comma-separated, or `all`: case, rank, samples,
            finished, regret, worst, iqm, J, J-worst, gap, economic, violation, violating, against,
            difference, p; default: case,rank,regret,worst,finished.
    """
    with cli.output(json) as out_:
        results = cosim.StudyResults.load(folder)
        page = results.report()
        _show_tables(results, out_, columns)
        out_.note(f"the report is {page.resolve()}")
        out_.json({"report": str(page), "runs": len(results.runs)})


def _summary(results: cosim.StudyResults) -> dict[str, Any]:
    """The study as a JSON document; `timing` is timing.csv by run."""
    from cosim.evaluation import TIMING
    from cosim.studies.run import read_table

    timing = read_table(results.folder / TIMING, needed=["run"])
    # JSON has null for a rank that is missing.
    summary = results.summary.astype({"rank": object})
    ranks = summary["rank"]
    summary["rank"] = ranks.where(ranks.notna(), None)
    timing_of_runs = timing.set_index("run")
    return {
        **results.about,
        "summary": summary.to_dict("records"),
        "aggregate": results.aggregate.to_dict("records"),
        "timing": timing_of_runs.to_dict("index"),
    }


def _show_tables(
    results: cosim.StudyResults,
    out_: cli.Output,
    columns: str | None = None,
) -> None:
    """Print a table for each scenario, with the columns that `--columns` names."""
    from cosim.studies.report_tables import REPORT_COLUMNS, SHORT_COLUMNS

    if columns is None:
        names = list(SHORT_COLUMNS)
    elif columns == "all":
        names = list(REPORT_COLUMNS)
    else:
        names = columns.split(",")
    for scenario in results.scenarios:
        header, rows = results.lines(scenario, names)
        out_.table(f"{results.name}: {scenario}", header, rows)


def reproduce(
    budget: Literal["quick", "full"] = "quick",
    out: cli.OutOption = Path("cosim-reproduction"),
    jobs: cli.JobsOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Train the paper's rule and ours, and compare with (a) naive, (b) tuned and the optimum.

    Runs the study results/reproduce.toml, or with --budget full results/reproduce-full.toml. The
    report has the paper's comparison at each reading of its open points, and the paper's figure.
    After an interruption run again with the same --out.

    Args:
        budget: quick: minutes on 2 cores; full: hours, with more seeds and samples.
    """
    with cli.output(json) as out_:
        from cosim.studies.paper_claim import paper_verdict
        from cosim.studies.stored import stored_results

        name = "reproduce" if budget == "quick" else "reproduce-full"
        file = stored_results() / f"{name}.toml"
        results = _execute(file, out, out_, jobs=jobs)
        page = results.report()
        _show_tables(results, out_)
        title, header, rows = results.paper()
        out_.table(title, header, rows)
        out_.note(f"the report is {page.resolve()}")
        claim = paper_verdict(results)
        for name, text in claim.items():
            out_.note(f"{name:<8} {text}")
        summary = _summary(results) | {"claim": claim}
        cli.write_summary(results.folder, summary)
        out_.json(summary)


@results_app.command("check")
def check_results(
    names: NamesArgument = None,
    folder: Annotated[Path | None, typer.Option("--results")] = None,
    jobs: cli.JobsOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Run the studies again that say `check = true`, and compare with the stored tables.

    Exit code 1: a column differs by more than its tolerance; the first such row is printed. Exit
    code 2: a stored table is missing or damaged. Nothing is written.

    Args:
        folder: Folder with the studies and tolerances.toml; default: ./results, else the installed
            ones.
    """
    with cli.output(json) as out_:
        from cosim.core.files import temporary_folder
        from cosim.studies import stored

        # In a checkout its own studies count, which may be newer than the installed ones.
        local = Path("results")
        if folder is None:
            folder = local if local.is_dir() else stored.stored_results()
        studies = stored.stored_studies(folder)
        tolerances = stored.load_tolerances(folder)
        regression = [name for name, table in studies.items() if table.check]
        chosen = stored.chosen(studies, names or regression)
        # What is missing, damaged or unknown is refused before the work, which takes minutes.
        for name in chosen:
            cosim.StudyResults.load(folder / name)
            stored.compared_tables(folder / name)
        differences: dict[str, list[str]] = {}
        with temporary_folder("cosim-results-") as work:
            for name in chosen:
                now = work / name
                definition = folder / f"{name}.toml"
                _execute(definition, now, out_, jobs=jobs, figures=False)
                before = folder / name
                differences[name] = stored.table_differences(name, before, now, tolerances)
        rows = []
        for name in studies:
            verdict = "not recomputed"
            if name in differences:
                verdict = "differs" if differences[name] else "same"
            rows.append((name, verdict))
        out_.table("stored studies", ("study", "verdict"), rows)
        for lines in differences.values():
            for line in lines:
                out_.note(line)
        same = not any(differences.values())
        out_.json({"same": same, "differences": differences})
    # Bad input is an error of code 2; this is an answer.
    if not same:
        raise typer.Exit(1)


@results_app.command("update")
def update_results(
    names: NamesArgument = None,
    folder: Annotated[Path, typer.Option("--results")] = Path("results"),
    jobs: cli.JobsOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Run studies and store their tables and reports, and the folder's README.

    Finished runs of long studies are kept in the folder's `.work`: run again to continue.

    Args:
        folder: Folder with the studies and tolerances.toml.
    """
    with cli.output(json) as out_:
        from cosim.studies import stored

        studies = stored.stored_studies(folder)
        for name in stored.chosen(studies, names or list(studies)):
            # Beside the stored tables, which are replaced when all runs are done.
            out = folder / stored.WORK / name
            results = _execute(folder / f"{name}.toml", out, out_, jobs=jobs)
            results.report()
            for table in stored.store(folder, name, out):
                out_.note(f"{name}: {table} is too large to be stored")
        # One page for all studies, those that were not run now too.
        stored.write_readme(folder, studies)
        out_.note(f"stored {', '.join(names or studies)} in {folder.resolve()}")
        out_.json({"updated": list(names or studies)})


@results_app.command("report")
def report_results(
    names: NamesArgument = None,
    folder: Annotated[Path, typer.Option("--results")] = Path("results"),
    json: cli.JsonOption = False,
) -> None:
    """Make the statistics and reports of stored studies anew, and the folder's README.

    They come from the stored measurements; no study is run. Times of the processor are not stored,
    so a report that is made anew has none.

    Args:
        folder: Folder with the studies and tolerances.toml.
    """
    with cli.output(json) as out_:
        from cosim.studies import stored

        studies = stored.stored_studies(folder)
        kept = [name for name in studies if (folder / name).is_dir()]
        chosen = stored.chosen(studies, names or kept)
        for name in chosen:
            stored.report_stored(folder, name)
            out_.note(f"{name}: {folder / name / 'report.md'}")
        stored.write_readme(folder, studies)
        out_.json({"reported": chosen})


@results_app.command("draw")
def draw_results(
    names: NamesArgument = None,
    folder: Annotated[Path, typer.Option("--results")] = Path("results"),
    json: cli.JsonOption = False,
) -> None:
    """Draw the figures of stored studies from their tables, as NAME/figures/*.svg.

    Figures are not stored. `make docs` draws all of them for the site, in some minutes.

    Args:
        folder: Folder with the studies and tolerances.toml.
    """
    with cli.output(json) as out_:
        from cosim.studies import stored

        studies = stored.stored_studies(folder)
        # A study whose tables are not stored has nothing to draw.
        kept = [name for name in studies if (folder / name).is_dir()]
        drawn = {}
        for name in stored.chosen(studies, names or kept):
            figures = stored.draw_stored(folder, name)
            drawn[name] = figures
            out_.note(f"{name}: {len(figures)} figures in {folder / name / 'figures'}")
        out_.json({"figures": drawn})
