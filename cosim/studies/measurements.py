"""Measurements of a study, read from its tables, and the statistics made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd

from cosim.core import statistics
from cosim.core.errors import StudyError
from cosim.core.files import read_json
from cosim.core.protocols import Array
from cosim.core.statistics import Estimate, over_runs, paired_difference, two_way
from cosim.evaluation import TIMING
from cosim.studies.operation_result import OperationResult, operation_result
from cosim.studies.operation_tables import WEEK, OperationLayout
from cosim.studies.plan import BASELINES
from cosim.studies.ranks import NO_SEED, costs_more, paired_runs, shared_ranks
from cosim.studies.run import GREEDY, INDICATORS, read_table
from cosim.studies.tables import (
    ABOUT,
    MEASURED_COLUMNS,
    OPERATION,
    RAW_TABLES,
    RUN_KEYS,
    RUN_STATE,
    SCHEMA,
    WHERE,
    timing_key,
)

AGGREGATED_MEANS = ["economic_cost", "mean_violation", "violating_share"]
RUN_COLUMNS = [
    *RUN_STATE, "J", "regret", "regret_low", "regret_high", "gap_closed", *AGGREGATED_MEANS,
    "failures",
]  # fmt: skip
SUMMARY_COLUMNS = [
    *WHERE, "samples", "plant_samples", "finished", "runs", "regret_median",
    "regret_median_low", "regret_median_high", "regret_worst", "regret_iqm", "regret_iqm_low",
    "regret_iqm_high", "J_median", "J_worst", "J_iqm", "gap_closed_median", *AGGREGATED_MEANS,
    "failures", "regret_wide_low", "regret_wide_high", "rank", "against", "difference",
    "difference_low", "difference_high", "difference_p",
]  # fmt: skip
AGGREGATE_COLUMNS = [
    "case", "scenarios", "runs", "regret_median", "regret_worst", "regret_iqm", "regret_iqm_low",
    "regret_iqm_high",
]  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class StudyMeasurements:
    """Measurements of a study in `folder`, as pandas frames of its finished runs.

    Attributes:
        folder: of the study.
        about: the document study.json: cases, scenarios, and the versions that made them.
        state: a row for each run: scenario, case, training_seed, status, samples, plant_samples.
        evaluation: a row for each run and noise seed.
        curves: a row for each row of a training's log, and one, without samples, for each
            controller on the noise of the curves.
    """

    folder: Path
    about: Mapping[str, Any]
    state: pd.DataFrame
    evaluation: pd.DataFrame
    curves: pd.DataFrame

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read a study's folder, or a stored one; raises StudyError."""
        folder = Path(folder)
        path = folder / ABOUT
        if not path.exists():
            raise StudyError(
                f"'{folder}' holds no study ({ABOUT}); give the --out of a cosim study run"
            )
        about = read_json(path, f"'{path}'", StudyError)
        if about.get("schema") != SCHEMA:
            raise StudyError(f"'{path}' has schema {about.get('schema')!r}; this is {SCHEMA}")
        tables = [read_table(folder / name, MEASURED_COLUMNS[name]) for name in RAW_TABLES]
        return cls(folder, about, *tables)

    @property
    def name(self) -> str:
        """The study's name."""
        return str(self.about["name"])

    @property
    def scenarios(self) -> list[str]:
        """Scenarios, in the study's order."""
        return list(self.about["scenarios"])

    @cached_property
    def cases(self) -> dict[str, dict[str, Any]]:
        """Cases by name, in the study's order: group, target, trained, samples, settings, …."""
        return {case["name"]: case for case in self.about["cases"]}

    @property
    def baselines(self) -> list[str]:
        """Names of the cases that figures show as lines to compare with."""
        return [name for name, case in self.cases.items() if case["group"] == BASELINES]

    # Measurements of the runs of a case

    @cached_property
    def indicators(self) -> dict[tuple[str, str], dict[str, Array]]:
        """Indicators (R, S) of R runs on S noise seeds, by scenario and case; raises StudyError."""
        indicators = {}
        rows = self.state[RUN_KEYS].merge(self.evaluation, on=RUN_KEYS, how="left")
        n_runs = self.state.groupby(WHERE).size()
        for where, measured in rows.groupby(WHERE, sort=False):
            # A run without a row has no seed; runs of unlike seeds do not fill a rectangle.
            has_all_runs = measured.seed.notna().all()
            if not has_all_runs or len(measured) % n_runs[where]:
                raise StudyError(f"the tables in '{self.folder}' are damaged: {where}")
            by_name = {}
            for name in INDICATORS:
                values = measured[name].to_numpy(dtype=np.float64)
                by_name[name] = values.reshape(n_runs[where], -1)
            indicators[where] = by_name
        return indicators

    def indicator(self, case: str, scenario: str, name: str = "J") -> Array:
        """An indicator of a case's runs over the noise seeds.

        Args:
            case: name of the case.
            scenario: name of the scenario.
            name: the indicator.

        Returns:
            Its values, (R, S); (0, 0) without runs.
        """
        measured = self.indicators.get((scenario, case))
        if measured is None:
            return np.zeros((0, 0))
        return measured[name]

    def runs_of(self, case: str, scenario: str) -> pd.DataFrame:
        """The case's rows of `runs` on a scenario, by training seed."""
        is_scenario = self.runs.scenario == scenario
        is_case = self.runs.case == case
        return self.runs[is_scenario & is_case]

    def reference(self, kind: str, scenario: str) -> Array | None:
        """J (S,) of a scenario's `optimum` or `naive`, or None."""
        case = self.about[kind].get(scenario, "")
        cost = self.indicator(case, scenario)
        return cost[0] if len(cost) else None

    def regret(self, case: str, scenario: str, runs: Sequence[int] = (0,)) -> Estimate:
        """Regret (J − J*)/|J*| of the mean of some runs, paired over the noise seeds.

        Args:
            case: name of the case.
            scenario: name of the scenario.
            runs: numbers of the runs, from 0, in the order of the training seeds.

        Returns:
            The regret and its 95 % interval; NaN without J*.
        """
        best = self.reference("optimum", scenario)
        if best is None:
            return Estimate(np.nan)
        cost = self._mean_cost(case, scenario, runs)
        return statistics.regret(cost, best)

    def gap_closed(self, case: str, scenario: str, runs: Sequence[int] = (0,)) -> Estimate:
        """Share (J_naive − J)/(J_naive − J*) of the mean of some runs; arguments as of `regret`."""
        best = self.reference("optimum", scenario)
        naive = self.reference("naive", scenario)
        if best is None or naive is None:
            return Estimate(np.nan)
        cost = self._mean_cost(case, scenario, runs)
        return statistics.gap_closed(cost, naive, best)

    def _mean_cost(self, case: str, scenario: str, runs: Sequence[int]) -> Array:
        """Mean J (S,) of some runs of a case."""
        cost = self.indicator(case, scenario)
        mean: Array = cost[list(runs)].mean(axis=0)
        return mean

    def regrets(self, case: str, scenario: str) -> Array:
        """Regret (R,) of each run; infinite if J is not finite, NaN if J* is unknown."""
        runs = self.runs_of(case, scenario)
        if self.reference("optimum", scenario) is None:
            return np.full(len(runs), np.nan)
        return np.where(np.isfinite(runs.J), runs.regret, np.inf)

    def is_trained_once(self, case: str, scenario: str) -> bool:
        """Whether a case has one training only, so that its spread is unknown."""
        is_trained = bool(self.cases[case]["trained"])
        return is_trained and len(self.indicator(case, scenario)) < 2

    def violations_per_week(self, case: str, scenario: str) -> Estimate:
        """Samples of a week that violate a bound: the median over a case's runs of their mean.

        Args:
            case: name of the case.
            scenario: name of the scenario.

        Returns:
            The number and its interval over training seeds and noise, or over the noise alone of a
            single run; NaN where the study does not say its sampling time.
        """
        share = self.indicator(case, scenario, "violating_share")
        sampling_time = self.sampling_time(scenario)
        if sampling_time is None or not share.size:
            return Estimate(np.nan)
        per_week = share * WEEK / sampling_time
        median = float(np.median(per_week.mean(axis=1)))
        # A "regret" against zero in units of one is the number itself.
        unit = np.ones(per_week.shape[1])
        zero = np.zeros_like(per_week)
        return Estimate(median, two_way(per_week, unit, zero))

    def sampling_time(self, scenario: str) -> float | None:
        """Sampling time in s; None in studies that an earlier version stored."""
        times: Mapping[str, float] = self.about.get("sampling_times", {})
        if scenario in times:
            return times[scenario]
        in_operation = self.about.get("operation") or {}
        if scenario in in_operation:
            return float(in_operation[scenario]["sampling_time"])
        return None

    # Tables of statistics

    @cached_property
    def runs(self) -> pd.DataFrame:
        """A row for each run: its state, J, regret with its interval over noise, indicators."""
        rows = []
        for (scenario, case), states in self.state.groupby(WHERE, sort=False):
            for run, state in enumerate(states.to_dict("records")):
                rows.append(state | self._statistics_of_run(case, scenario, run))
        table = pd.DataFrame(rows, columns=RUN_COLUMNS)
        return table.astype({"training_seed": "Int64"})

    def _statistics_of_run(self, case: str, scenario: str, run: int) -> dict[str, Any]:
        """Columns of `runs` that are measured, of the run with a number."""
        indicators = self.indicators[scenario, case]
        cost = float(indicators["J"][run].mean())
        regret = self.regret(case, scenario, [run])
        row: dict[str, Any] = {
            # The mean cost of a run that diverged may be NaN.
            "J": cost if np.isfinite(cost) else np.inf,
            **columns_of("regret", regret),
            "gap_closed": self.gap_closed(case, scenario, [run]).value,
            "failures": int(indicators["failures"][run].sum()),
        }
        for name in AGGREGATED_MEANS:
            row[name] = float(indicators[name][run].mean())
        return row

    @cached_property
    def summary(self) -> pd.DataFrame:
        """A row for each scenario and case, the least median J first.

        The median regret is that of the middle run, or of the mean of both middle ones.
        """
        rows: list[dict[str, Any]] = []
        for scenario in self.scenarios:
            rows_here = []
            for case in self.cases:
                # Of a case that has not run, or not here, there is no row.
                if len(self.indicator(case, scenario)):
                    rows_here.append(self._summary_row(case, scenario))
            rows_here.sort(key=lambda row: float(row["J_median"]))
            by_cost = [row["case"] for row in rows_here]
            ranks = self._ranks(scenario, by_cost)
            for row in rows_here:
                row["rank"] = ranks[row["case"]]
            rows += rows_here
        table = pd.DataFrame(rows, columns=SUMMARY_COLUMNS)
        return table.astype({"rank": "Int64"})

    def _summary_row(self, case: str, scenario: str) -> dict[str, Any]:
        """A case's row of the summary, but for its rank."""
        runs = self.runs_of(case, scenario)
        n_runs = len(runs)
        by_cost = np.argsort(runs.J.to_numpy(), kind="stable")
        cost = runs.J.to_numpy()[by_cost]
        regrets = self.regrets(case, scenario)[by_cost]
        # The middle run, or both middle ones.
        middle = list(by_cost[(n_runs - 1) // 2 : n_runs // 2 + 1])
        regret_iqm = over_runs([regrets]) if n_runs > 1 else Estimate(regrets[0])
        diverged = runs.status.str.startswith("diverged")
        row: dict[str, Any] = {
            "scenario": scenario,
            "case": case,
            "samples": runs.samples.max(),
            "plant_samples": runs.plant_samples.max(),
            "finished": int((~diverged).sum()),
            "runs": n_runs,
            **columns_of("regret_median", self.regret(case, scenario, middle)),
            "regret_worst": float(regrets[-1]),
            **columns_of("regret_iqm", regret_iqm),
            "J_median": float(np.median(cost)),
            "J_worst": float(cost[-1]),
            "J_iqm": over_runs([cost]).value,
            "gap_closed_median": self.gap_closed(case, scenario, middle).value,
            "failures": int(runs.failures.sum()),
        }
        for name in AGGREGATED_MEANS:
            row[name] = float(np.median(runs[name]))
        row.update(self._wide_interval(case, scenario))
        row.update(self._difference(case, scenario))
        return row

    def _wide_interval(self, case: str, scenario: str) -> dict[str, float]:
        """Interval of the median regret over training seeds and noise, as columns."""
        best = self.reference("optimum", scenario)
        interval = None
        if best is not None and not self.is_trained_once(case, scenario):
            interval = two_way(self.indicator(case, scenario), best)
        return columns_of("regret_wide", Estimate(np.nan, interval))

    def _difference(self, case: str, scenario: str) -> dict[str, Any]:
        """Columns of the paired difference from the case's counterpart; NaN without it or J*."""
        best = self.reference("optimum", scenario)
        counterpart = self.cases[case].get("against") or ""
        difference = Estimate(np.nan)
        p = np.nan
        # A counterpart may not run on this scenario.
        if best is not None and len(self.indicator(counterpart, scenario)):
            cost, other_cost = self._pairs(case, counterpart, scenario)
            # Without a training seed in common nothing is known.
            if cost.size:
                median, interval, p = paired_difference(cost, other_cost, best)
                difference = Estimate(median, interval)
        columns = columns_of("difference", difference)
        return {"against": counterpart or None, **columns, "difference_p": p}

    def _pairs(self, case: str, other: str, scenario: str) -> tuple[Array, Array]:
        """J (R, S) of two cases over the training seeds that both have; a controller has any."""
        cost = self._cost_by_training_seed(case, scenario)
        other_cost = self._cost_by_training_seed(other, scenario)
        return paired_runs(cost, other_cost)

    def _cost_by_training_seed(self, case: str, scenario: str) -> pd.DataFrame:
        """J of a case's runs, a row for each training seed."""
        seeds = self.runs_of(case, scenario).training_seed
        return pd.DataFrame(self.indicator(case, scenario), index=seeds.fillna(NO_SEED))

    def _ranks(self, scenario: str, cases: Sequence[str]) -> dict[str, int | None]:
        """Ranks of cases on a scenario, given in the order of their median J."""
        best = self.reference("optimum", scenario)

        def is_worse(case: str, leader: str) -> bool:
            cost, leader_cost = self._pairs(case, leader, scenario)
            # Without a training seed in common nothing is known.
            if not cost.size:
                return False
            # Without J* the leader's cost is the unit of the difference, whose sign counts.
            unit = leader_cost.mean(axis=0) if best is None else best
            return costs_more(cost, leader_cost, unit)

        trained_once = [case for case in cases if self.is_trained_once(case, scenario)]
        return shared_ranks(cases, trained_once, is_worse)

    @cached_property
    def aggregate(self) -> pd.DataFrame:
        """Regret over all runs of cases that ran on all (several) scenarios with known J*.

        The bootstrap is stratified: runs are resampled within their scenario.
        """
        scenarios = []
        for name in self.scenarios:
            if self.reference("optimum", name) is not None:
                scenarios.append(name)
        rows = []
        for case in self.cases:
            strata = [self.regrets(case, scenario) for scenario in scenarios]
            ran_on_all = all(len(regrets) for regrets in strata)
            # Of one scenario the summary says the same.
            if len(strata) > 1 and ran_on_all:
                rows.append({"case": case, **_aggregate_columns(strata)})
        rows.sort(key=lambda row: float(row["regret_iqm"]))
        return pd.DataFrame(rows, columns=AGGREGATE_COLUMNS)

    # Operation

    @property
    def scenarios_in_operation(self) -> list[str]:
        """Scenarios on which cases learn in operation."""
        return list(self.about.get("operation") or {})

    def operation_result(self, scenario: str) -> OperationResult:
        """Regrets of the runs in operation on a scenario; raises StudyError."""
        runs = read_table(self.folder / OPERATION, needed=["samples"])
        # A table that an earlier version stored lacks the latest columns.
        runs = runs.reindex(columns=MEASURED_COLUMNS[OPERATION])
        greedy = read_table(self.folder / GREEDY, MEASURED_COLUMNS[GREEDY])
        return operation_result(
            runs[runs.scenario == scenario],
            greedy[greedy.scenario == scenario],
            self.about["optimum"].get(scenario, ""),
        )

    def operation_layout(self, scenario: str) -> OperationLayout:
        """What tables and figure of a scenario in operation show."""
        about = self.about["operation"][scenario]
        return OperationLayout(about["sampling_time"], about["columns"], about["drawn"])

    def processor_seconds(self, scenario: str) -> dict[str, float]:
        """Median processor time in s of a case's runs in operation, up to their last sample."""
        path = self.folder / TIMING
        # Stored studies have no times.
        if not path.is_file():
            return {}
        timing = read_table(path, needed=["run"]).set_index("run")
        last_mark = self.about["operation"][scenario]["columns"][-1]
        is_here = self.state.scenario == scenario
        is_training = self.state.training_seed.notna()
        runs = self.state[is_here & is_training]
        # As `Run` writes its name.
        names = runs.case + f" on {scenario}, seed " + runs.training_seed.astype(str)
        keys = names.map(lambda name: timing_key(name, last_mark))
        seconds = keys.map(timing.training_seconds)
        return dict(seconds.groupby(runs.case).median())


def _aggregate_columns(strata: Sequence[Array]) -> dict[str, Any]:
    """Columns of the aggregate of a case with regrets (R_i,) of its runs on each scenario."""
    regrets = np.concatenate(strata)
    return {
        "scenarios": len(strata),
        "runs": len(regrets),
        "regret_median": np.median(regrets),
        "regret_worst": regrets.max(),
        **columns_of("regret_iqm", over_runs(strata)),
    }


def columns_of(name: str, estimate: Estimate) -> dict[str, float]:
    """An estimate as columns of a table.

    Args:
        name: column of the value; those of the interval are `name_low` and `name_high`.
        estimate: a missing interval is NaN.
    """
    low, high = estimate.interval or (np.nan, np.nan)
    return {name: estimate.value, f"{name}_low": low, f"{name}_high": high}
