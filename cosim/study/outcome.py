"""`run_study`: a study in one call, and results that show themselves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.study.engine import Study, silent
from cosim.study.results import StudyResults
from cosim.study.runner import Report


def run_study(
    source: str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    report: Report = silent,
) -> StudyResults:
    """Run a study file, or the same document, and return what it measured.

    What `out` holds already is not done again; the other arguments and the errors are those of
    `Study.load`, `Study.from_dict` and `Study.run`.
    """
    found = Study.from_dict(dict(source)) if isinstance(source, Mapping) else Study.load(source)
    return found.run(out, jobs=jobs, scheduler=scheduler, report=report)
