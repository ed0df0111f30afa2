"""`cosim reproduce`: the paper's section Simulations in one command."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options import JobsOption, JsonOption, OutOption
from cosim.cli.output import output
from cosim.cli.study import execute, show, write_summary


class BudgetName(enum.StrEnum):
    """The budgets, for the command line."""

    quick = "quick"
    full = "full"


def reproduce(
    budget: Annotated[
        BudgetName,
        typer.Option(
            "--budget",
            help="quick: minutes on 2 cores; full: hours, with more seeds and samples.",
        ),
    ] = BudgetName.quick,
    out: OutOption = Path("cosim-reproduction"),
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Train the paper's rule and ours, and compare with (a) naive, (b) tuned and the optimum.

    A study (results/reproduce.toml, results/reproduce-full.toml): writes report.html and report.md
    with the paper's comparison at each reading of its open points and the paper's figure, and the
    tables of `cosim study run`. Run again with the same --out to go on after an interruption.
    """
    with output(json) as out_:
        from cosim.studies.stored import stored_results

        name = "reproduce" if budget is BudgetName.quick else "reproduce-full"
        execute(stored_results() / f"{name}.toml", out, out_, jobs=jobs)
        from cosim.studies.results import StudyResults

        results = StudyResults.load(out)
        summary = write_summary(results)
        page = results.report()
        show(results, out_)
        out_.table(*results.paper())
        out_.note(f"the report is {page.resolve()}")
        out_.json(summary)
