"""`run_study`: a study in one call, and results that show themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.study.engine import Study, silent
from cosim.study.formatting import HEADER, lines
from cosim.study.report import write_report
from cosim.study.results import StudyResults
from cosim.study.runner import Report
from cosim.text_tables import markdown_table


@dataclass(frozen=True)
class StudyOutcome(StudyResults):
    """What a study measured, with its report."""

    def report(self) -> Path:
        """Write report.html, report.md and figures/ into the study's folder; the page's path."""
        return write_report(self)

    def table(self, scenario: str) -> str:
        """A scenario's table as Markdown, least regret first."""
        return markdown_table(HEADER, lines(self, scenario))


def run_study(
    source: str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    report: Report = silent,
) -> StudyOutcome:
    """Run a study file, or the same document, and return what it measured.

    What `out` holds already is not done again; the other arguments and the errors are those of
    `Study.load`, `Study.from_dict` and `Study.run`.
    """
    found = Study.from_dict(dict(source)) if isinstance(source, Mapping) else Study.load(source)
    results = found.run(out, jobs=jobs, scheduler=scheduler, report=report)
    return StudyOutcome(results.folder, results.about, results.runs)
