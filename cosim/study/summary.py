"""What the tables say of each case: median, worst and interquartile mean over training runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cosim.statistics import Estimate, over_runs
from cosim.study.records import RunResult
from cosim.study.results import StudyResults

NAN = float("nan")
MEDIANS = ("economic_cost", "mean_violation", "violating_share", "failures")
RUN_COLUMNS = (
    "scenario", "case", "training_seed", "status", "samples", "plant_samples", "J", "regret",
    "regret_low", "regret_high", "gap_closed", *MEDIANS,
)  # fmt: skip
COLUMNS = (
    "scenario", "case", "samples", "plant_samples", "finished", "runs", "regret_median",
    "regret_median_low", "regret_median_high", "regret_worst", "regret_iqm", "regret_iqm_low",
    "regret_iqm_high", "J_median", "J_worst", "J_iqm", "gap_closed_median", *MEDIANS,
)  # fmt: skip
AGGREGATE_COLUMNS = (
    "case", "scenarios", "runs", "regret_median", "regret_worst", "regret_iqm", "regret_iqm_low",
    "regret_iqm_high",
)  # fmt: skip


def run_rows(results: StudyResults) -> list[dict[str, Any]]:
    """A row for each run; regret with its interval, paired over the noise seeds."""
    rows = []
    for run in results.runs:
        regret = results.regret(run)
        rows.append(
            {
                "scenario": run.scenario,
                "case": run.case,
                "training_seed": run.seed,
                "status": run.status,
                "samples": run.samples,
                "plant_samples": run.plant_samples,
                "J": run.J,
                "regret": regret.value,
                **_ends("regret", regret.t),
                "gap_closed": results.gap_closed(run).value,
                **{name: float(np.mean(run.indicators[name])) for name in MEDIANS[:-1]},
                "failures": int(np.sum(run.indicators["failures"])),
            }
        )
    return rows


def summary_rows(results: StudyResults, *scenarios: str) -> list[dict[str, Any]]:
    """A row for each scenario (all, if none is named) and case, the least J first.

    Medians are those of the middle runs (of both, where their number is even), so that the paired
    interval of the median regret is that of real runs.
    """
    rows = []
    for scenario in scenarios or results.scenarios:
        known = [
            _summary(results, runs)
            for case in results.cases
            if (runs := results.of(case, scenario))
        ]
        rows += sorted(known, key=lambda row: float(row["J_median"]))
    return rows


def _summary(results: StudyResults, runs: Sequence[RunResult]) -> dict[str, Any]:
    ranked = sorted(runs, key=lambda run: run.J)
    middle = ranked[(len(ranked) - 1) // 2 : len(ranked) // 2 + 1]
    median = results.regret(*middle)
    regrets = np.array([results.regrets.get(run.key, NAN) for run in ranked])
    spread = over_runs([regrets]) if len(runs) > 1 else Estimate(float(regrets[0]))
    return {
        "scenario": runs[0].scenario,
        "case": runs[0].case,
        "samples": max(run.samples for run in runs),
        "plant_samples": max(run.plant_samples for run in runs),
        "finished": sum(run.finished for run in runs),
        "runs": len(runs),
        "regret_median": median.value,
        **_ends("regret_median", median.t),
        "regret_worst": float(regrets[-1]),
        "regret_iqm": spread.value,
        **_ends("regret_iqm", spread.bootstrap),
        "J_median": float(np.median([run.J for run in runs])),
        "J_worst": ranked[-1].J,
        "J_iqm": over_runs([np.array([run.J for run in ranked])]).value,
        "gap_closed_median": results.gap_closed(*middle).value,
        **{
            name: float(np.median([np.mean(run.indicators[name]) for run in runs]))
            for name in MEDIANS[:-1]
        },
        "failures": int(sum(np.sum(run.indicators["failures"]) for run in runs)),
    }


def aggregate_rows(results: StudyResults) -> list[dict[str, Any]]:
    """Cases that ran on every scenario whose J* is known: regret over all their runs.

    The bootstrap is stratified: runs are resampled within their scenario.
    """
    scenarios = [name for name in results.scenarios if results.optimum(name) is not None]
    rows = []
    for case in results.cases if len(scenarios) > 1 else ():
        strata = [
            np.array([results.regrets[run.key] for run in results.of(case, scenario)])
            for scenario in scenarios
        ]
        if any(len(stratum) == 0 for stratum in strata):
            continue
        spread, everything = over_runs(strata), np.concatenate(strata)
        rows.append(
            {
                "case": case,
                "scenarios": len(scenarios),
                "runs": len(everything),
                "regret_median": float(np.median(everything)),
                "regret_worst": float(everything.max()),
                "regret_iqm": spread.value,
                **_ends("regret_iqm", spread.bootstrap),
            }
        )
    return sorted(rows, key=lambda row: float(row["regret_iqm"]))


def _ends(name: str, interval: tuple[float, float] | None) -> dict[str, float]:
    low, high = interval or (NAN, NAN)
    return {f"{name}_low": low, f"{name}_high": high}
