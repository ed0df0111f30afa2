"""From what a run of a study stored to its results and tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.files import write_atomically
from cosim.study import theta
from cosim.study.online import ONLINE, online_csv
from cosim.study.plan import Plan, Run
from cosim.study.records import CURVE, EVALUATED, RunResult
from cosim.study.results import ABOUT, SCHEMA, StudyResults
from cosim.study.store import EVALUATION, GREEDY, INDICATORS, RunStore
from cosim.study.summary import (
    AGGREGATE_COLUMNS,
    COLUMNS,
    RUN_COLUMNS,
    aggregate_rows,
    run_rows,
    summary_rows,
)
from cosim.study.tables import CURVES, RUNS, TIMING, curves_csv, evaluation_csv, to_csv
from cosim.study.traces import draw, keep
from cosim.text_tables import parse_records

Array = NDArray[np.float64]
SUMMARY, AGGREGATE = "summary.csv", "aggregate.csv"


def collect(plan: Plan, out: Path, stores: Mapping[str, RunStore]) -> StudyResults:
    """The finished runs of a plan, in the order of scenarios, cases and training seeds."""
    definition = plan.definition
    cases = [*definition.references, *definition.cases]
    scenarios, names = list(definition.scenarios), [case.name for case in cases]
    found = [
        result for run in plan.runs if (result := _result(run, stores[str(run.key)])) is not None
    ]
    found.sort(
        key=lambda run: (
            scenarios.index(run.scenario),
            names.index(run.case),
            -1 if run.seed is None else run.seed,
        )
    )
    about = {
        "schema": SCHEMA,
        "name": definition.name,
        "title": definition.table.title,
        "description": definition.table.description,
        "scenarios": scenarios,
        "cases": [
            {
                "name": case.name,
                "group": case.group,
                "target": definition.relative(case.target),
                "trained": case.algorithm is not None,
                "samples": case.samples,
                "start": definition.relative(case.start),
                "nmpc": case.nmpc,
                "settings": dict(case.settings),
                "scenarios": list(case.scenarios),
            }
            for case in cases
        ],
        "optimum": definition.optima,
        "naive": dict.fromkeys(scenarios, definition.naive),
        "online": None if definition.table.online is None else definition.table.online.model_dump(),
        "runs": len(plan.runs),
        "tables": list(definition.table.tables),
        "pictures": [],
        "made_with": plan.provenance,
    }
    if (settings := definition.table.theta) is not None:
        about["theta"] = {"settings": settings.model_dump(), "scales": theta.scales(plan)}
    return StudyResults(out, json.loads(json.dumps(about)), found)


def _result(run: Run, store: RunStore) -> RunResult | None:
    """The run's result; None while it is not finished."""
    if store.missing_online(run.online):
        return None
    if any(store.missing(file, seeds, steps) for file, (seeds, steps) in run.noise.items()):
        return None
    noise = {file: store.indicators(file, steps) for file, (_, steps) in run.noise.items()}
    progress = store.progress()
    if run.training is not None and not progress.ended:
        return None
    seeds, steps = run.noise[EVALUATION]
    greedy = [noise[GREEDY][seed]["J"] for seed in run.noise[GREEDY][0]] if run.greedy else []
    return RunResult(
        scenario=run.key.scenario,
        case=run.key.case,
        seed=run.key.seed,
        status=progress.status or EVALUATED,
        samples=progress.samples,
        plant_samples=progress.plant_samples,
        seeds=seeds,
        steps=steps,
        indicators={
            name: np.array([noise[EVALUATION][seed][name] for seed in seeds]) for name in INDICATORS
        },
        curve=_curve(progress.log) if progress.log else {},
        greedy_J=float(np.mean(greedy)) if greedy else float("nan"),
    )


def _curve(log: str) -> dict[str, Array]:
    rows = parse_records(log)
    return {
        name: np.array([float(row.get(name) or "nan") for row in rows], dtype=np.float64)
        for name in CURVE
    }


def write(results: StudyResults, plan: Plan, stores: Mapping[str, RunStore], figures: bool) -> None:
    """Write all that a study keeps; study.json last, so that what it says is there."""
    out = results.folder
    keep(plan, out, stores)
    pictures = draw(plan, out, stores) if figures else []
    write_atomically(out / EVALUATION, evaluation_csv(results.runs))
    write_atomically(out / CURVES, curves_csv(results.runs))
    if plan.definition.table.online is not None:
        write_atomically(out / ONLINE, online_csv(plan, results.runs, stores))
    if plan.definition.table.theta is not None:
        write_atomically(out / theta.FILE, theta.theta_csv(results.runs, stores))
    write_atomically(out / RUNS, to_csv(RUN_COLUMNS, run_rows(results)))
    write_atomically(out / SUMMARY, to_csv(COLUMNS, summary_rows(results)))
    aggregate = aggregate_rows(results)
    if aggregate:
        write_atomically(out / AGGREGATE, to_csv(AGGREGATE_COLUMNS, aggregate))
    write_atomically(out / TIMING, _timing(stores))
    write_atomically(
        out / ABOUT,
        json.dumps(dict(results.about) | {"pictures": pictures}, indent=1, sort_keys=True) + "\n",
    )


def _timing(stores: Mapping[str, RunStore]) -> str:
    rows: list[dict[str, Any]] = [
        {
            "run": name,
            "training_seconds": store.progress().wall_seconds,
            "functions": " and ".join(store.functions),
        }
        for name, store in stores.items()
    ]
    return to_csv(("run", "training_seconds", "functions"), rows)
