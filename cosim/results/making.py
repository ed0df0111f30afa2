"""Runs an experiment's commands and stores what they give."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any

from cosim.errors import ResultsError
from cosim.evaluation.provenance import code_hash, versions
from cosim.files import write_atomically
from cosim.results.check import table_path
from cosim.results.experiments import Experiment
from cosim.results.figures import Policy, draw
from cosim.results.tidy import DIGITS, LARGEST, Tidy, join, read

Runner = Callable[[list[str], Path], None]
"""Runs a `cosim` command, given as words, with an output folder; raises what the command raises."""

SUMMARY, MADE = "summary.json", "made.json"


def compute(
    name: str, experiment: Experiment, runner: Runner, root: Path, work: Path
) -> tuple[Tidy, dict[str, Path]]:
    """Run an experiment's commands; returns its table and the runs' folders by label.

    The commands run in the folder `root`, so that relative paths in them mean what they mean to
    a user there; `work` holds their output, and what they can resume from. Raises ResultsError
    if a run leaves no table, and whatever the commands raise.
    """
    folders, tables = {}, {}
    for label in experiment.runs:
        folders[label] = folder = work.resolve() / name / label
        folder.mkdir(parents=True, exist_ok=True)
        with chdir(root):
            runner(experiment.command(label), folder)
        path = folder / experiment.table
        if not path.is_file():
            raise ResultsError(f"'{experiment.runs[label]}' wrote no {experiment.table}")
        origin = f"{experiment.table} of '{experiment.runs[label]}'"
        tables[label] = read(path.read_text("utf-8"), experiment.keys, experiment.drop, origin)
    return join(tables), folders


def store(
    folder: Path,
    name: str,
    experiment: Experiment,
    table: Tidy,
    runs: dict[str, Path],
    policy: Policy,
) -> None:
    """Write an experiment's table, files, summaries and figures, replacing what was stored."""
    text = table.to_csv()
    if len(text.encode()) > LARGEST:
        raise ResultsError(
            f"the table of '{name}' has {len(text.encode())} bytes, more than {LARGEST}; "
            "take fewer seeds or steps, or drop columns"
        )
    target = folder / name
    target.mkdir(parents=True, exist_ok=True)
    for label, run in runs.items():
        for file in experiment.files:
            if not (run / file).is_file():
                raise ResultsError(f"'{experiment.runs[label]}' wrote no {file}")
            write_atomically(target / f"{label}-{file}", _copied(run / file, label, experiment))
    summaries = {label: _summary(run) for label, run in runs.items()}
    write_atomically(target / SUMMARY, _json(summaries))
    draw(experiment, runs, target, policy)
    made = {"runs": dict(experiment.runs), "versions": versions(), "code_hash": code_hash()}
    write_atomically(target / MADE, _json(made))
    # Last: a table is there only if all that belongs to it is.
    write_atomically(table_path(folder, name, experiment), text)


def _copied(path: Path, label: str, experiment: Experiment) -> bytes:
    """A run's file; in Markdown the links to its other files follow them to their stored names."""
    if path.suffix != ".md":
        return path.read_bytes()
    text = path.read_text("utf-8")
    for file in experiment.files:
        text = text.replace(f"]({file})", f"]({label}-{file})")
    return text.encode()


def _summary(run: Path) -> dict[str, Any]:
    path = run / SUMMARY
    if not path.is_file():
        return {}
    document: dict[str, Any] = json.loads(path.read_text("utf-8"), parse_float=_rounded)
    document.pop("timing", None)
    return document


def _rounded(number: str) -> float:
    """As the tables are, so that a last bit does not show as a change."""
    return float(f"{float(number):.{DIGITS}g}")


def _json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=1, sort_keys=True) + "\n"
