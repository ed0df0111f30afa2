"""Tables of a study, made of its finished runs, and the document that says what they are of."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.core.scenario import Scenario
from cosim.core.training_options import LOG
from cosim.evaluation import EVALUATION, NAIVE, TIMING
from cosim.studies.definition import Case, Study
from cosim.studies.operation import OPERATION_METRICS
from cosim.studies.plan import StudyPlan
from cosim.studies.run import GREEDY, INDICATORS, RunStore, read_table, typed

ABOUT = "study.json"
SCHEMA = 1
"""Schema of study.json."""
CURVES = "curves.csv"
RUNS_TABLE = "runs.csv"
SUMMARY = "summary.csv"
AGGREGATE = "aggregate.csv"
OPERATION = "operation.csv"
RAW_TABLES = (RUNS_TABLE, EVALUATION, CURVES)
"""Tables of every study that are read again."""
STUDY_FILES = (*RAW_TABLES, SUMMARY, AGGREGATE, OPERATION, GREEDY, TIMING, ABOUT, "summary.json")
"""Files beside those of the runs; all in a folder belong to one study."""
WHERE = ["scenario", "case"]
RUN_KEYS = [*WHERE, "training_seed"]
RUN_STATE = [*RUN_KEYS, "status", "samples", "plant_samples"]
MEASURED_COLUMNS = {
    RUNS_TABLE: RUN_STATE,
    EVALUATION: [*RUN_KEYS, "seed", "steps", *INDICATORS],
    CURVES: [*RUN_KEYS, "samples", "J", "greedy_J", "td_error"],
    OPERATION: [*RUN_KEYS, "samples", *OPERATION_METRICS],
    GREEDY: [*RUN_KEYS, "samples", "seed", "J"],
}
"""Columns of the tables that runs give; `RAW_TABLES` are those of every study."""
CASE_FIELDS = (
    "name",
    "group",
    "samples",
    "nmpc",
    "settings",
    "scenarios",
    "start",
    "target",
)
"""Entry of a case without training in study.json."""


def measured_tables(plan: StudyPlan, stores: Iterable[RunStore]) -> dict[str, pd.DataFrame]:
    """The tables `MEASURED_COLUMNS` of the finished runs of a plan.

    Args:
        plan: whose order of scenarios and cases the rows have; runs of one case are in the order
            of `stores`.
        stores: what is there of each run.

    Returns:
        The tables by the names of their files.
    """
    parts: dict[str, list[pd.DataFrame]] = {name: [] for name in MEASURED_COLUMNS}
    for store in _finished(plan, stores):
        for name, rows in _rows_of_run(store):
            parts[name].append(rows)
    tables = {}
    for name, columns in MEASURED_COLUMNS.items():
        # A study without operation has no rows of some tables; one frame is needed to join.
        frames = parts[name] or [pd.DataFrame()]
        rows = pd.concat(frames, ignore_index=True)
        # A log has more columns than its table.
        table = rows.reindex(columns=columns)
        tables[name] = typed(table)
    return tables


def _finished(plan: StudyPlan, stores: Iterable[RunStore]) -> list[RunStore]:
    """The finished runs by scenario and case, in the order of the study."""
    cases = [case.name for case in plan.definition.all_cases]
    order = list(product(plan.definition.scenarios, cases))
    finished = [store for store in stores if store.complete]

    def position(store: RunStore) -> int:
        return order.index((store.run.scenario.name, store.run.case))

    # The sort is stable: runs of one case stay in the order of their seeds.
    finished.sort(key=position)
    return finished


def _rows_of_run(store: RunStore) -> Iterator[tuple[str, pd.DataFrame]]:
    """Rows that a finished run gives to the tables, by the table's file."""
    run = store.run
    key = {
        "scenario": run.scenario.name,
        "case": run.case,
        "training_seed": run.seed,
    }
    state = {
        # A controller is not trained, and has no status of its own.
        "status": store.status or "evaluated",
        "samples": int(store.about.get("samples", 0)),
        "plant_samples": int(store.about.get("plant_samples", 0)),
    }
    yield RUNS_TABLE, pd.DataFrame([key | state])
    if run.training is not None:
        log = read_table(store.folder / LOG)
        log = log.assign(**key)
        yield CURVES, log
        if run.training.marks:
            yield OPERATION, log
    optimum_runs = []
    for file, noise in run.noise.items():
        # A trajectory is kept as a file, not as rows of a table.
        if noise.whole:
            continue
        rows = store.measured(file)
        rows = rows.rename_axis("seed").reset_index()
        if file == EVALUATION:
            yield EVALUATION, rows.assign(**key, steps=noise.steps)
        elif file == GREEDY:
            # A controller does not learn: one level, without a number of samples.
            level = key | {"greedy_J": float(rows.J.mean())}
            yield CURVES, pd.DataFrame([level])
        elif file in run.marks:
            yield GREEDY, rows.assign(**key, samples=run.marks[file])
        else:
            # The optimum runs on the noise of every training seed, as long as up to a mark.
            key_of_noise = key | {
                "training_seed": rows.seed,
                "samples": noise.steps,
            }
            costs = rows[["J"]]
            optimum_runs.append(costs.assign(**key_of_noise))
    if optimum_runs:
        rows = pd.concat(optimum_runs)
        # As the rows of a training: its marks, then those of the next seed.
        yield OPERATION, rows.sort_values(["training_seed", "samples"])


def timing_table(stores: Iterable[RunStore]) -> pd.DataFrame:
    """Seconds that each run's training took; in operation the processor's up to each mark, too."""
    rows = []
    for store in stores:
        name = str(store.run)
        # A controller takes no time to train.
        timing = store.about.get("timing", {})
        wall_seconds = float(timing.get("wall_seconds", 0.0))
        rows.append((name, wall_seconds))
        processor_seconds: Mapping[str, float] = timing.get("processor_seconds", {})
        for mark, seconds in processor_seconds.items():
            key = timing_key(name, mark)
            rows.append((key, float(seconds)))
    return pd.DataFrame(rows, columns=["run", "training_seconds"])


def timing_key(run: str, mark: int | str) -> str:
    """Name of a row of timing.csv: the run up to a mark of operation.

    Args:
        run: name of the run, as `Run` writes it.
        mark: number of samples.
    """
    return f"{run}, sample {mark}"


def document(plan: StudyPlan) -> dict[str, Any]:
    """The document study.json of a plan."""
    definition = plan.definition
    scenarios = definition.scenarios
    sampling_times = {}
    curves = {}
    for name, scenario in scenarios.items():
        sampling_times[name] = scenario.sampling_time
        if definition.has_curves:
            noise = definition.held_out(name)
            curves[name] = [len(noise.seeds), noise.steps]
    # Without its folder, which is another one on another machine.
    file = Path(definition.file).name if definition.file else None
    about = {
        "schema": SCHEMA,
        "name": definition.name,
        "title": definition.table.title,
        "description": definition.table.description,
        "scenarios": list(scenarios),
        "cases": [_about_case(definition, case) for case in definition.all_cases],
        "file": file,
        "optimum": definition.optima,
        "naive": dict.fromkeys(scenarios, definition.named(NAIVE)),
        "curves": curves,
        "sampling_times": sampling_times,
        "runs": len(plan.runs),
        "tables": list(definition.table.tables),
        "made_with": {**plan.provenance, "commit": _commit()},
    }
    about_operation = _about_operation(definition)
    if about_operation:
        about["operation"] = about_operation
    # As it is when it is read again: tuples are lists.
    return dict(json.loads(json.dumps(about)))


def _about_case(study: Study, case: Case) -> dict[str, Any]:
    """Entry of a case in study.json."""
    about = {name: getattr(case, name) for name in CASE_FIELDS}
    about["trained"] = case.algorithm is not None
    about["against"] = study.counterpart(case)
    return about


def _about_operation(study: Study) -> dict[str, dict[str, Any]]:
    """Entry of operation in study.json, by scenario; {} where no case learns in operation."""
    table = study.table.operation
    learns = any(case.algorithm for case in study.cases)
    if table is None or not learns:
        return {}
    about = {}
    for name, scenario in study.scenarios.items():
        marks = study.marks(name)
        # A time at which no θ was taken cannot be shown.
        wanted = study.samples_of(table.columns, name)
        columns = [mark for mark in wanted if mark in marks]
        about[name] = {
            "sampling_time": scenario.sampling_time,
            "marks": marks,
            # Without columns of its own a table shows every mark.
            "columns": columns or marks,
            "drawn": table.drawn,
            "changes": _plant_changes(scenario),
        }
    return about


def _plant_changes(scenario: Scenario) -> list[dict[str, Any]]:
    """When a scenario's plant changes, and to what: entries with `sample` and `parameters`."""
    changes = []
    for change in scenario.plant.changes or ():
        entry = {
            # The first one at or after the change; their ratio has a rounding error.
            "sample": math.ceil(round(change.time / scenario.sampling_time, 6)),
            "parameters": dict(change.parameters),
        }
        changes.append(entry)
    return changes


def _commit() -> str:
    """Short commit of the checkout that the package is in, `+` if it was edited; else empty."""
    folder = Path(__file__).parent
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        described = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    # An installed package is in no checkout, and a machine may have no git.
    except (OSError, subprocess.SubprocessError):
        return ""
    return described.stdout.strip()
