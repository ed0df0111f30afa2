"""What the runs of a study cost themselves: regret of their own samples, and how it goes on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.errors import StudyError
from cosim.figures.online import Course, plot_online
from cosim.statistics import regret, regret_terms, regrets, shown
from cosim.study.document import OnlineTable
from cosim.study.plan import Plan, Run
from cosim.study.records import RunResult
from cosim.study.results import StudyResults
from cosim.study.store import RunKey, RunStore, safe
from cosim.study.tables import KEYS, read_numbers, to_csv
from cosim.study.traces import LOGS
from cosim.text_tables import read_records
from cosim.validation import suggestion

Array = NDArray[np.float64]
Costs = dict[str, dict[int, Array]]
"""Mean costs of the blocks (K,) of each run, by case and training seed."""
ONLINE = "online.csv"
TITLE = "The runs' own samples on `{}`: regret in %, exploration's cost included"


def online_csv(plan: Plan, runs: Iterable[RunResult], stores: Mapping[str, RunStore]) -> str:
    """A row for each block of each run: the samples at its end and its mean cost."""
    planned = {run.key: run for run in plan.runs}
    rows: list[dict[str, Any]] = []
    for result in runs:
        run = planned[RunKey(*result.key)]
        for seed, samples, costs in _blocks(run, result, stores[str(run.key)]):
            key = {"scenario": result.scenario, "case": result.case, "training_seed": seed}
            rows += [
                key | {"samples": int(done), "J": float(cost)}
                for done, cost in zip(samples, costs, strict=True)
            ]
    return to_csv((*KEYS, "samples", "J"), rows)


def _blocks(run: Run, result: RunResult, store: RunStore) -> list[tuple[int, Array, Array]]:
    if result.seed is not None:
        # The first row of a log is θ at the start; it has no cost.
        known = ~np.isnan(result.curve["J"])
        return [(result.seed, result.curve["samples"][known], result.curve["J"][known])]
    if run.online is None:
        return []
    steps, block = run.online.steps, run.online.block
    found = store.online(run.online).items()
    return [
        (seed, np.minimum(block * np.arange(1, len(costs) + 1), steps), np.array(costs))
        for seed, costs in found
    ]


def tables(results: StudyResults) -> list[tuple[str, tuple[str, ...], list[list[str]]]]:
    """Title, header and rows for each scenario: regret of the run, and of each of its periods.

    Against the optimum's own run on the same noise, paired over the training seeds.
    """
    if results.about.get("online") is None:
        return []
    return [_table(results, scenario) for scenario in results.scenarios]


def _table(results: StudyResults, scenario: str) -> tuple[str, tuple[str, ...], list[list[str]]]:
    settings = OnlineTable.model_validate(results.about["online"])
    costs, best = _costs(results, scenario)
    each = settings.period // settings.block
    periods = max((len(run) // each for run in best.values()), default=0)
    rows: list[tuple[float, list[str]]] = []
    for case, runs in costs.items():
        seeds = sorted(seed for seed in runs if seed in best and len(runs[seed]) == len(best[seed]))
        if not seeds:
            continue
        own = np.array([runs[seed] for seed in seeds])
        optimum = np.array([best[seed] for seed in seeds])
        found = regret(own.mean(axis=1), optimum.mean(axis=1))
        single = regrets(own.mean(axis=1), optimum.mean(axis=1))
        cut = [slice(i * each, (i + 1) * each) for i in range(periods)]
        parts = [regret(own[:, c].mean(axis=1), optimum[:, c].mean(axis=1)) for c in cut]
        by_period = [shown(part.value, None, 100, 3) for part in parts]
        line = [case, str(len(seeds)), shown(found.value, found.t, 100, 3)]
        line += [shown(float(f(single)), None, 100, 3) for f in (np.median, np.max)]
        rows.append((found.value, [*line, *by_period]))
    header = ("case", "runs", "regret %, mean [95 %]", "median", "worst")
    periods_header = tuple(f"period {i + 1}" for i in range(periods))
    lines = [line for _, line in sorted(rows, key=lambda row: row[0])]
    return TITLE.format(scenario), (*header, *periods_header), lines


def _costs(results: StudyResults, scenario: str) -> tuple[Costs, dict[int, Array]]:
    """Costs by case and seed, and the optimum's; none where the scenario has no optimum."""
    found: dict[str, dict[int, list[float]]] = {}
    for row in read_records(results.folder / ONLINE, StudyError):
        if row["scenario"] == scenario:
            runs = found.setdefault(row["case"], {})
            runs.setdefault(int(row["training_seed"]), []).append(float(row["J"]))
    costs = {case: {s: np.array(v) for s, v in runs.items()} for case, runs in found.items()}
    order = [case for case in results.cases if case in costs]
    costs = {case: costs[case] for case in order}
    return costs, costs.get(results.about["optimum"].get(scenario, ""), {})


def draw(results: StudyResults, scenario: str, target: Path, suffixes: Iterable[str]) -> list[str]:
    """Draw the course of regret under the logs' signals; returns the figure's name."""
    settings = OnlineTable.model_validate(results.about["online"])
    costs, best = _costs(results, scenario)
    courses = {}
    for case, runs in costs.items():
        if runs is best:
            continue
        seeds = [s for s in runs if s in best and len(runs[s]) == len(best[s])]
        values = [100 * regret_terms(runs[s], best[s]) for s in seeds]
        if values:
            samples = settings.block * np.arange(1, len(values[0]) + 1, dtype=np.float64)
            courses[case] = Course(samples, np.array(values))
    if not courses:
        return []
    signals: dict[str, dict[str, tuple[Array, Array]]] = {}
    columns: list[str] = []
    for case in courses:
        path = results.folder / LOGS / f"{safe(scenario)}-{safe(case)}.csv"
        if path.is_file():
            log = read_numbers(path)
            columns = list(log)
            for name in settings.signals:
                if name in log:
                    signals.setdefault(name, {})[case] = (log["samples"], log[name])
    if columns and (unknown := [name for name in settings.signals if name not in signals]):
        raise StudyError(
            f"online.signals: no log has a column '{unknown[0]}'{suggestion(unknown[0], columns)}"
        )
    name = f"online-{safe(scenario)}"
    for suffix in suffixes:
        plot_online(courses, signals, settings.period, target / f"{name}.{suffix}")
    return [name]
