"""`cosim results`: check the stored studies, or make them anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options import JobsOption, JsonOption
from cosim.cli.output import output
from cosim.cli.study import execute

app = typer.Typer(help="Check the stored studies, or make them anew.", no_args_is_help=True)

NamesArgument = Annotated[
    list[str] | None, typer.Argument(help="Studies; default: all that apply.")
]
FolderOption = Annotated[
    Path, typer.Option("--results", help="Folder with the studies and tolerances.toml.")
]
StoredOption = Annotated[
    Path | None,
    typer.Option(
        "--results",
        help="Folder with the studies and tolerances.toml; default: ./results, else the "
        "installed ones.",
        show_default=False,
    ),
]


@app.callback()
def results() -> None:
    """Check the stored studies, or make them anew."""


@app.command()
def check(
    names: NamesArgument = None,
    folder: StoredOption = None,
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Run the studies again that say `check = true`, and compare with the stored tables.

    Exit code 1 where a signal differs by more than its tolerance, with the first row that differs;
    2 where a stored table is missing or damaged. Writes nothing.
    """
    with output(json) as out_:
        from cosim.files import temporary_folder
        from cosim.studies.results import StudyResults
        from cosim.studies.stored import (
            chosen,
            differences,
            load_tolerances,
            stored_results,
            stored_studies,
        )

        folder = folder or (Path("results") if Path("results").is_dir() else stored_results())
        tolerances, studies = load_tolerances(folder), stored_studies(folder)
        quick = chosen(studies, names or [name for name, table in studies.items() if table.check])
        for name in quick:
            StudyResults.load(folder / name)
        found: dict[str, list[str]] = {}
        with temporary_folder("cosim-results-") as work:
            for name in quick:
                execute(folder / f"{name}.toml", work / name, out_, jobs=jobs, figures=False)
                found[name] = differences(name, folder / name, work / name, tolerances)
        rows = [(name, _verdict(found.get(name))) for name in studies]
        out_.table("stored studies", ("study", "verdict"), rows)
        for lines in found.values():
            for line in lines:
                out_.note(line)
        out_.json({"same": not any(found.values()), "differences": found})
    if any(found.values()):
        raise typer.Exit(1)


@app.command()
def update(
    names: NamesArgument = None,
    folder: FolderOption = Path("results"),
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Run studies and store their tables, figures and reports, and the folder's README.

    What long studies have finished is kept in the folder's `.work`; run again to go on.
    """
    with output(json) as out_:
        from cosim.studies.stored import (
            WORK,
            chosen,
            report,
            store,
            stored_studies,
            write_readme,
        )

        studies = stored_studies(folder)
        for name in chosen(studies, names or list(studies)):
            out = folder / WORK / name
            execute(folder / f"{name}.toml", out, out_, jobs=jobs)
            report(out)
            for table in store(folder, name, out):
                out_.note(f"{name}: {table} is too large to be stored")
        write_readme(folder, studies)
        out_.note(f"stored {', '.join(names or studies)} in {folder.resolve()}")
        out_.json({"updated": list(names or studies)})


def _verdict(lines: list[str] | None) -> str:
    if lines is None:
        return "not recomputed"
    return "differs" if lines else "same"
