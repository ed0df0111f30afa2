"""A study's report: one HTML page that needs nothing else, and the same tables as Markdown."""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, select_autoescape

from cosim.core.files import write_atomically
from cosim.core.result import markdown_table
from cosim.evaluation import TIMING
from cosim.studies.measurements import StudyMeasurements
from cosim.studies.report_tables import (
    SHORT_COLUMNS,
    TitledRows,
    aggregate_table,
    cases_table,
    further_tables,
    runs_table,
    scenario_table,
)

PAGE = "report.html"
MARKDOWN = "report.md"
FOLDER = "figures"
"""Folder of the figures."""
_OTHER_UNIT = "No J* is known: a difference is relative to |J'|, of the case under against."
_BEST_CASE = "Regrets in operation are against the best case at the time."


def write_report(study: StudyMeasurements, figures: Mapping[str, Sequence[str]]) -> Path:
    """Write the pages of a study into its folder.

    Args:
        study: the measurements.
        figures: names of each scenario's figures, whose files are in `FOLDER` already.

    Returns:
        The HTML page.
    """

    def picture(name: str) -> dict[str, str] | None:
        path = study.folder / FOLDER / f"{name}.svg"
        # Those of a stored study's single runs are there once `cosim results draw` drew them.
        return _image(path) if path.is_file() else None

    page = rendered(PAGE, **_content(study, figures), picture=picture)
    write_atomically(study.folder / PAGE, page)
    write_markdown(study, figures)
    return study.folder / PAGE


def write_markdown(study: StudyMeasurements, figures: Mapping[str, Sequence[str]]) -> None:
    """Write report.md of a study into its folder.

    Args:
        study: the measurements.
        figures: names of each scenario's figures, which the page links.
    """
    page = rendered(MARKDOWN, **_content(study, figures))
    write_atomically(study.folder / MARKDOWN, page)


def _content(study: StudyMeasurements, figures: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """What the templates of both pages fill in."""
    n_runs = len(study.state)
    # A study that was given as a mapping has no file; the command names one of its name.
    file = study.about.get("file") or f"{study.name}.toml"
    return {
        "title": study.about["title"] or study.name,
        "description": study.about["description"],
        "runs": n_runs,
        "missing": study.about["runs"] - n_runs,
        "sections": _sections(study, figures),
        "every": runs_table(study),
        "command": ["cosim", "study", "run", file],
        "made": _made_with(study.about["made_with"]),
        "date": _date(study.folder / TIMING),
    }


def rendered(template: str, **context: Any) -> str:
    """A template of this folder, filled in."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=select_autoescape(["html"]),
        # A line with a tag alone leaves no blank line, which would end a Markdown table.
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["markdown"] = _markdown
    environment.filters["command"] = shlex.join
    return environment.get_template(template).render(context)


def _markdown(table: TitledRows) -> str:
    """A table as Markdown, as templates ask for it."""
    header, rows = table
    return markdown_table(header, rows)


@dataclass(frozen=True)
class Section:
    """A section of the report.

    Attributes:
        title: its heading.
        table: header and rows.
        short: some columns of it, which the page shows first; None: it shows all.
        figures: names of figures.
        note: a paragraph above the table.
    """

    title: str
    table: TitledRows | None = None
    short: TitledRows | None = None
    figures: Sequence[str] = ()
    note: str = ""


def _sections(study: StudyMeasurements, figures: Mapping[str, Sequence[str]]) -> list[Section]:
    """Sections of the report, in its order; figures are named by scenario."""
    sections = []
    for scenario in study.scenarios:
        section = Section(
            title=f"Scenario {scenario}",
            table=scenario_table(study, scenario),
            short=scenario_table(study, scenario, SHORT_COLUMNS),
            figures=figures[scenario],
            note=_noise_note(study, scenario),
        )
        sections.append(section)
    # Of one scenario the aggregate has no rows.
    if len(study.aggregate):
        sections.append(Section("All scenarios", aggregate_table(study)))
    for title, header, rows in further_tables(study):
        sections.append(Section(title, (header, rows)))
    pictures = study.about["pictures"]
    if pictures:
        sections.append(Section("Sample by sample", figures=pictures))
    sections.append(Section("Cases", cases_table(study)))
    return sections


def _noise_note(study: StudyMeasurements, scenario: str) -> str:
    """The noise that a scenario's figures were measured on, in words."""
    rows = study.evaluation[study.evaluation.scenario == scenario]
    if rows.empty:
        return "No run is finished."
    n_seeds = rows.seed.nunique()
    note = f"Table and regret: {n_seeds} noise seeds × {rows.steps.iloc[0]} samples."
    if study.reference("optimum", scenario) is None:
        note += f" {_OTHER_UNIT}"
        if scenario in study.scenarios_in_operation:
            note += f" {_BEST_CASE}"
    if scenario not in study.about["curves"]:
        return note
    curve_seeds, curve_steps = study.about["curves"][scenario]
    return (
        f"{note} Learning curves: {curve_seeds} other seeds × {curve_steps} samples. Regrets of a "
        "case differ between the two."
    )


def _made_with(provenance: Mapping[str, Any]) -> str:
    """Versions and code that a study was made with, in words."""
    made = f"Made with {provenance['versions']}; code {provenance['code_hash']}"
    if provenance.get("commit"):
        made += f"; commit {provenance['commit']}"
    return made


def _image(path: Path) -> dict[str, str]:
    """An SVG file as an `img`'s source, and its width in CSS pixels."""
    content = path.read_bytes()
    # Within the page, which then needs no other file.
    encoded = base64.b64encode(content).decode()
    width = "auto"
    points = re.search(rb'width="([\d.]+)pt"', content)
    if points:
        # Larger than on paper, whose letters are too small for a screen.
        width = f"{1.7 * float(points[1]):.0f}px"
    return {
        "source": f"data:image/svg+xml;base64,{encoded}",
        "width": width,
    }


def _date(path: Path) -> str:
    """Day (UTC) on which a file of the study was written; empty without it."""
    if not path.is_file():
        return ""
    written = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    return written.date().isoformat()
