"""`Study`: load a study, run it, look at what it measured."""

from __future__ import annotations

from pathlib import Path

from cosim.errors import FailedRunsError
from cosim.study.definition import Definition
from cosim.study.plan import Plan, plan
from cosim.study.results import StudyResults
from cosim.study.runner import Report, Runner, State


def silent(state: State, line: str) -> None:
    """Report nothing."""


class Study(Definition):
    """Cases × scenarios × training seeds: `Study.load(FILE).run(OUT)` trains and evaluates all.

    A study file says what is compared with what (see the how-to page); `Study.from_dict` takes the
    same document from Python. Raises StudyError, and what scenarios and trainer raise, before any
    work is done.
    """

    def plan(self) -> Plan:
        """Every run of the study, checked."""
        return plan(self)

    def run(
        self,
        out: str | Path,
        *,
        jobs: int = 1,
        scheduler: str | None = None,
        report: Report = silent,
        planned: Plan | None = None,
        figures: bool = True,
    ) -> StudyResults:
        """Train and evaluate all that `out` does not hold yet, and write the tables there.

        `jobs` worker processes, or the Dask cluster at `scheduler`; the tables' bytes depend on
        neither. `report` gets the state after every unit of work and a line for each run that ends
        or fails; `planned` is what `plan` returned, if it is known; `figures` draws the
        study's trajectories and logs. Raises FailedRunsError after
        all others are done and written.
        """
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        planned = planned or self.plan()
        runner = Runner(planned, folder, report)
        runner.go(jobs, scheduler)
        results = StudyResults.collect(planned, folder)
        results.write(planned, figures=figures)
        if runner.failures:
            name, failure = next(iter(runner.failures.items()))
            more = len(runner.failures) - 1
            others = f" ({more} more run{'s' if more > 1 else ''} failed)" if more else ""
            raise FailedRunsError(f"{name}: {failure.message}{others}; run again to try anew")
        return results
