"""Results of a study: its measurements with their tables, figures and report; `study` runs one."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from cosim.core.errors import FailedRunsError, StudyError
from cosim.core.files import holding, staged
from cosim.core.result import Shown, TextTable, text_table
from cosim.core.simulation import reporting
from cosim.core.validation import instead
from cosim.evaluation import TIMING, Progress
from cosim.figures.style import FORMATS, SCREEN, WIDTH, save_set
from cosim.studies.definition import Study
from cosim.studies.figures import STUDY_FIGURES
from cosim.studies.kept import draw_kept, keep_files
from cosim.studies.measurements import StudyMeasurements
from cosim.studies.paper_claim import paper_table
from cosim.studies.plan import StudyPlan, plan
from cosim.studies.report import FOLDER, write_report
from cosim.studies.report_tables import (
    SHORT_COLUMNS,
    TitledRows,
    further_tables,
    scenario_table,
)
from cosim.studies.run import GREEDY, Runner, RunStore, folder_name, frame_csv
from cosim.studies.tables import (
    ABOUT,
    AGGREGATE,
    OPERATION,
    RAW_TABLES,
    RUNS_TABLE,
    STUDY_FILES,
    SUMMARY,
    document,
    measured_tables,
    timing_table,
)


@dataclass(frozen=True, eq=False, repr=False)
class StudyResults(StudyMeasurements, Shown):
    """Measurements of a study in `folder`, with their tables, figures and report."""

    @classmethod
    def write(
        cls,
        plan: StudyPlan,
        out: Path,
        stores: Iterable[RunStore],
        *,
        draw: bool = True,
    ) -> StudyResults:
        """Write the tables and kept files of a plan's finished runs, study.json last.

        Args:
            plan: the study's plan.
            out: folder of the study.
            stores: what is there of each run.
            draw: whether the kept trajectories and logs are drawn.
        """
        # First: figures are drawn from the copies, so that a stored study draws the same.
        keep_files(plan, out)
        tables = measured_tables(plan, stores)
        about = document(plan)
        about["pictures"] = draw_kept(plan, out) if draw else []
        results = cls(out, about, *(tables[name] for name in RAW_TABLES))
        # Of a study without operation these tables have no rows.
        if not results.scenarios_in_operation:
            del tables[OPERATION]
            del tables[GREEDY]
        tables[RUNS_TABLE] = results.runs
        tables[SUMMARY] = results.summary
        tables[TIMING] = timing_table(stores)
        if len(results.aggregate):
            tables[AGGREGATE] = results.aggregate
        # All or none: tables of two states of a study would contradict each other.
        with staged(out, STUDY_FILES) as stage:
            for name, table in tables.items():
                (stage / name).write_text(frame_csv(table), "utf-8")
            text = json.dumps(about, indent=1, sort_keys=True) + "\n"
            (stage / ABOUT).write_text(text, "utf-8")
        return results

    def to_pandas(self) -> pd.DataFrame:
        """A copy of `runs`, a row for each run."""
        return self.runs.copy()

    def lines(self, scenario: str, columns: Sequence[str] | None = None) -> TitledRows:
        """Header and rows of a scenario's table as texts.

        Args:
            scenario: its name.
            columns: names as `cosim study report --columns` takes them; by default all of which
                something is known.

        Raises:
            StudyError: there is no such column.
        """
        return scenario_table(self, scenario, columns)

    def table(
        self,
        scenario: str | None = None,
        columns: Sequence[str] | None = SHORT_COLUMNS,
        *,
        format: str = "markdown",
    ) -> str:
        """A scenario's table, lowest J first.

        Args:
            scenario: its name; None: the tables of all scenarios, each below its name.
            columns: names as `cosim study report --columns` takes them; None: all of which
                something is known.
            format: markdown, latex or html.

        Raises:
            StudyError: there is no such scenario or column.
            CosimError: there is no such format.
        """
        if scenario is None:
            tables = []
            for name in self.scenarios:
                tables.append(f"{name}\n\n{self.table(name, columns, format=format)}")
            return "\n".join(tables)
        if scenario not in self.scenarios:
            raise StudyError(
                f"the study has no scenario '{scenario}'{instead(scenario, self.scenarios)}"
            )
        header, rows = self.lines(scenario, columns)
        return text_table(header, rows, format)

    def further_tables(self) -> Iterator[TextTable]:
        """Title, header and rows of the tables that the study asks for beside its summary."""
        return further_tables(self)

    def paper(self) -> TextTable:
        """Title, header and rows: gains over the paper's two baselines, of each trained case."""
        return paper_table(self)

    def figure(self, name: str | None = None, width: float = WIDTH) -> Figure:
        """Draw `curves`, `regret` or `operation` of a scenario, as `curves-paper`.

        Args:
            name: of the figure; None is the first scenario's regret.
            width: in inches; `cosim.figures.style` has that of one and of two columns of a journal.

        Raises:
            StudyError: there is no such figure, or nothing to draw in it.
        """
        if name is None:
            name = f"regret-{self.scenarios[0]}"
        drawn = {}
        for scenario, kind in product(self.scenarios, STUDY_FIGURES):
            drawn[f"{kind}-{scenario}"] = (STUDY_FIGURES[kind], scenario)
        if name in drawn:
            draw, scenario = drawn[name]
            figure = draw(self, scenario, width)
            if figure is not None:
                return figure
            raise StudyError(f"'{name}': the study's tables have nothing to draw in this figure")
        # Only what can be drawn is offered.
        offered = []
        for other, (draw, scenario) in drawn.items():
            if draw(self, scenario, width) is not None:
                offered.append(other)
        raise StudyError(f"this study draws no figure '{name}'{instead(name, offered)}")

    def draw(self, folder: Path, formats: Sequence[str] = FORMATS) -> dict[str, list[str]]:
        """Draw the figures of the tables.

        Args:
            folder: where the files are written.
            formats: of the files, `svg` or `png`; a file of each is written.

        Returns:
            Names of the figures by scenario.
        """
        names = {}
        for scenario in self.scenarios:
            drawn = []
            for kind, draw in STUDY_FIGURES.items():
                figure = draw(self, scenario, SCREEN)
                # Without J*, or a training, there may be nothing to draw.
                if figure is not None:
                    drawn.append((f"{kind}-{folder_name(scenario)}", figure))
            names[scenario] = save_set(drawn, folder, formats)
        return names

    def report(self) -> Path:
        """Write report.html, report.md and figures/ into the study's folder; returns the page."""
        names = self.draw(self.folder / FOLDER)
        return write_report(self, names)

    def _facts(self) -> dict[str, object]:
        return {
            "name": self.name,
            "scenarios": len(self.scenarios),
            "cases": len(self.cases),
            "runs": len(self.state),
            "folder": self.folder,
        }

    def _repr_html_(self) -> str:
        parts = []
        for name in self.scenarios:
            header, rows = self.lines(name, SHORT_COLUMNS)
            table = pd.DataFrame(rows, columns=list(header)).to_html(index=False)
            parts.append(f"<h4>{escape(name)}</h4>{table}")
        return "".join(parts)


def study(
    source: Study | str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Progress | bool = False,
    planned: StudyPlan | None = None,
    figures: bool = True,
) -> StudyResults:
    """Do the runs of a study that its folder lacks, and write its tables there.

    Args:
        source: a study, its file, or the same document as a mapping.
        out: the study's folder.
        jobs: worker processes; 1 works in this process. No byte of a table depends on it.
        scheduler: address of a Dask scheduler, used in place of `jobs`.
        progress: a `Progress`, called after every work item, and with a line for each run that
            ends; True draws a bar.
        planned: the study's plan, if it is known.
        figures: whether the study's trajectories and logs are drawn.

    Returns:
        The results of all finished runs.

    Raises:
        StudyError: the study is no valid one, and what scenarios and algorithms raise, before any
            work is done.
        FailedRunsError: runs failed; all others are done and written.
    """
    if isinstance(source, Mapping):
        source = Study.from_dict(source)
    definition = source if isinstance(source, Study) else Study.load(source)
    folder = Path(out)
    planned = planned or plan(definition)
    # Two processes in one folder would give out the same work twice.
    with holding(folder), reporting(progress, definition.name, planned.samples) as tell:
        runner = Runner(planned.runs, folder, tell)
        for line in runner.remarks:
            tell(0, "", line)
        runner.run(jobs, scheduler)
        results = StudyResults.write(planned, folder, runner.stores.values(), draw=figures)
    # Raised at the end: a failed run must not cost the others' results.
    if runner.failures:
        name, failure = next(iter(runner.failures.items()))
        more = len(runner.failures) - 1
        others = f" ({more} more failed)" if more else ""
        raise FailedRunsError(
            f"{name}: {failure.message}{others}; once that is mended, the same command goes on"
        )
    return results
