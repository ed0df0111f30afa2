"""Runs of a plan, from their folders to the document and the frames of a study's results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.errors import StudyError
from cosim.files import read_json
from cosim.studies import theta
from cosim.studies.plan import EVALUATION, GREEDY, NAIVE, Plan, Run
from cosim.studies.report import commit
from cosim.studies.store import CURVE, INDICATORS, KEYS, LOG, RUN, STATE, measured, read_table

SCHEMA = 1
EVALUATED = "evaluated"


def ordered(plan: Plan) -> list[Run]:
    """The runs by scenario, case and training seed, in the study's order."""
    definition = plan.definition
    names = [case.name for case in definition.all_cases]
    scenarios = list(definition.scenarios)
    return sorted(
        plan.runs,
        key=lambda run: (
            scenarios.index(run.key.scenario),
            names.index(run.key.case),
            -1 if run.key.seed is None else run.key.seed,
        ),
    )


def finished(plan: Plan, state: pd.DataFrame) -> list[Run]:
    """The runs of a plan that `state` has a row for."""
    known = state[KEYS].astype(object).where(state[KEYS].notna(), None)
    done = set(known.itertuples(index=False, name=None))
    return [r for r in ordered(plan) if (r.key.scenario, r.key.case, r.key.seed) in done]


def document(plan: Plan) -> dict[str, Any]:
    """The document study.json of a plan."""
    definition = plan.definition
    scenarios = list(definition.scenarios)
    curves = {name: definition.held_out(name) for name in scenarios}
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
                "against": definition.counterpart(case),
            }
            for case in definition.all_cases
        ],
        "file": Path(definition.file).name if definition.file else None,
        "optimum": definition.optima,
        "naive": dict.fromkeys(scenarios, definition.named(NAIVE)),
        "curves": {name: [len(noise.seeds), noise.steps] for name, noise in curves.items()},
        "online": None if definition.table.online is None else definition.table.online.model_dump(),
        "runs": len(plan.runs),
        "tables": list(definition.table.tables),
        "pictures": [],
        "made_with": dict(plan.provenance) | {"commit": commit()},
    }
    if (table := definition.table.operation) is not None:
        about["operation"] = {
            name: {
                "sampling_time": scenario.sampling_time,
                "marks": (marks := definition.marks(name)),
                "columns": [m for m in definition.samples_of(table.columns, name) if m in marks]
                or marks,
                "drawn": table.drawn,
            }
            for name, scenario in definition.scenarios.items()
        }
    if (settings := definition.table.theta) is not None:
        about["theta"] = {"settings": settings.model_dump(), "scales": theta.scales(plan)}
    found: dict[str, Any] = json.loads(json.dumps(about))
    return found


def frames(plan: Plan, out: Path) -> list[pd.DataFrame]:
    """State, evaluation and curves of the finished runs, by scenario, case and training seed.

    Raises StudyError where a file of a run is damaged.
    """
    found = [one for run in ordered(plan) if (one := _collected(run, out)) is not None]
    headers = (STATE, [*KEYS, "seed", "steps", *INDICATORS], [*KEYS, *CURVE])
    parts = [[one[i] for one in found if len(one[i])] for i in range(len(headers))]
    return [
        pd.concat(own, ignore_index=True) if own else pd.DataFrame(columns=header)
        for own, header in zip(parts, headers, strict=True)
    ]


def _collected(run: Run, out: Path) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame] | None:
    """State, evaluation and curves of a run; None while it is not finished."""
    folder = out / run.key.folder
    if not (folder / RUN).is_file():
        return None
    document = read_json(folder / RUN, f"'{folder / RUN}'", StudyError)
    kept = {file: noise for file, noise in run.noise.items() if not noise.whole}
    found = {file: measured(folder, run, file) for file in kept}
    if run.training is not None and not document.get("status"):
        return None
    if any(set(noise.seeds) - set(found[file].index) for file, noise in kept.items()):
        return None
    own = found[EVALUATION].loc[list(run.noise[EVALUATION].seeds)].reset_index()
    key = {"scenario": run.key.scenario, "case": run.key.case, "training_seed": run.key.seed}
    state = key | {
        "status": document.get("status") or EVALUATED,
        "samples": int(document.get("samples", 0)),
        "plant_samples": int(document.get("plant_samples", 0)),
    }
    curve = pd.DataFrame(columns=CURVE)
    if run.training is not None:
        curve = read_table(folder / LOG).reindex(columns=CURVE)
    elif GREEDY in run.noise:
        greedy = found[GREEDY].loc[list(run.noise[GREEDY].seeds)]
        curve = pd.DataFrame([{"greedy_J": float(greedy.J.mean())}], columns=CURVE)
    one, other, third = (frame.assign(**key) for frame in (pd.DataFrame([state]), own, curve))
    curves = {"samples": "Int64"} | dict.fromkeys(CURVE[1:], float)
    return (
        one[STATE].astype({"training_seed": "Int64"}),
        other[[*KEYS, "seed", "steps", *INDICATORS]].astype({"training_seed": "Int64"}),
        third[[*KEYS, *CURVE]].astype({"training_seed": "Int64"} | curves),
    )


def timing(plan: Plan, out: Path) -> pd.DataFrame:
    """Seconds that each run's training took; in operation the processor's up to each mark, too."""
    rows = []
    for run in plan.runs:
        path = out / run.key.folder / RUN
        document = read_json(path, f"'{path}'", StudyError) if path.is_file() else {}
        clock = document.get("timing", {})
        seconds = {str(run.key): clock.get("wall_seconds", 0.0)}
        marks = clock.get("processor_seconds", {})
        seconds |= {f"{run.key}, sample {mark}": value for mark, value in marks.items()}
        rows += [{"run": name, "training_seconds": float(value)} for name, value in seconds.items()]
    return pd.DataFrame(rows, columns=["run", "training_seconds"])
