"""Measurements of a study, read from its tables, and the statistics made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd

from cosim.core.errors import StudyError
from cosim.core.files import read_json
from cosim.core.protocols import Array
from cosim.core.statistics import Estimate, over_runs, two_way
from cosim.evaluation import TIMING
from cosim.studies.case_runs import AGGREGATED_MEANS, CaseRuns, columns_of
from cosim.studies.definition import BASELINES
from cosim.studies.operation_result import OperationResult, operation_result
from cosim.studies.operation_tables import WEEK, OperationLayout
from cosim.studies.ranks import shared_ranks
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

RUN_COLUMNS = [
    *RUN_STATE,
    "J",
    "regret",
    "regret_low",
    "regret_high",
    "gap_closed",
    *AGGREGATED_MEANS,
    "failures",
]
SUMMARY_COLUMNS = [
    *WHERE,
    "samples",
    "plant_samples",
    "finished",
    "runs",
    "regret_median",
    "regret_median_low",
    "regret_median_high",
    "regret_worst",
    "regret_iqm",
    "regret_iqm_low",
    "regret_iqm_high",
    "J_median",
    "J_worst",
    "J_iqm",
    "gap_closed_median",
    *AGGREGATED_MEANS,
    "failures",
    "regret_wide_low",
    "regret_wide_high",
    "rank",
    "against",
    "difference",
    "difference_low",
    "difference_high",
    "difference_p",
]
AGGREGATE_COLUMNS = [
    "case",
    "scenarios",
    "runs",
    "regret_median",
    "regret_worst",
    "regret_iqm",
    "regret_iqm_low",
    "regret_iqm_high",
]


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
        schema = about.get("schema")
        if schema != SCHEMA:
            raise StudyError(f"'{path}' has schema {schema!r}; this is {SCHEMA}")
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

    # The runs of a case

    @cached_property
    def indicators(self) -> dict[tuple[str, str], dict[str, Array]]:
        """Indicators (R, S) of R runs on S noise seeds, by scenario and case; raises StudyError."""
        indicators = {}
        rows = self.state[RUN_KEYS].merge(self.evaluation, on=RUN_KEYS, how="left")
        n_runs_of = self.state.groupby(WHERE).size()
        for where, measured in rows.groupby(WHERE, sort=False):
            n_runs = n_runs_of[where]
            # A run without a row has no seed; runs of unlike seeds do not fill a rectangle.
            has_all_runs = measured.seed.notna().all()
            if not has_all_runs or len(measured) % n_runs:
                raise StudyError(f"the tables in '{self.folder}' are damaged: {where}")
            by_name = {}
            for name in INDICATORS:
                values = measured[name].to_numpy(dtype=np.float64)
                by_name[name] = values.reshape(n_runs, -1)
            indicators[where] = by_name
        return indicators

    @cached_property
    def case_runs(self) -> dict[tuple[str, str], CaseRuns]:
        """The runs of each case that has any, by scenario and case; raises StudyError."""
        case_runs = {}
        for where, state in self.state.groupby(WHERE, sort=False):
            scenario, case = where
            case_runs[where] = CaseRuns(
                case=case,
                scenario=scenario,
                is_trained=bool(self.cases[case]["trained"]),
                state=state,
                indicators=self.indicators[where],
                optimum=self.reference("optimum", scenario),
                naive=self.reference("naive", scenario),
            )
        return case_runs

    def reference(self, kind: str, scenario: str) -> Array | None:
        """J of a scenario's optimum, or of its naive NMPC, on the noise of the evaluation.

        Args:
            kind: `optimum` or `naive`.
            scenario: name of the scenario.

        Returns:
            J, (S,); None where it has not run.
        """
        case = self.about[kind].get(scenario, "")
        measured = self.indicators.get((scenario, case))
        if measured is None:
            return None
        # Both are controllers, of which there is one run.
        cost: Array = measured["J"][0]
        return cost

    def runs_of(self, case: str, scenario: str) -> pd.DataFrame:
        """Rows of `runs`, by training seed.

        Args:
            case: name of the case.
            scenario: name of the scenario.
        """
        is_scenario = self.runs.scenario == scenario
        is_case = self.runs.case == case
        return self.runs[is_scenario & is_case]

    def regrets(self, case: str, scenario: str) -> Array:
        """Regret of each run.

        Args:
            case: name of the case.
            scenario: name of the scenario.

        Returns:
            The regrets, (R,); infinite if J is not finite, NaN if J* is unknown.
        """
        runs = self.case_runs.get((scenario, case))
        return np.empty(0) if runs is None else runs.run_regrets

    def violations_per_week(self, case: str, scenario: str) -> Estimate:
        """Samples of a week that violate a bound: the median over a case's runs of their mean.

        Args:
            case: name of the case.
            scenario: name of the scenario.

        Returns:
            The number and its interval over training seeds and noise, or over the noise alone of a
            single run; NaN where the study does not say its sampling time.
        """
        runs = self.case_runs.get((scenario, case))
        sampling_time = self.sampling_time(scenario)
        if sampling_time is None or runs is None:
            return Estimate(np.nan)
        samples_per_week = WEEK / sampling_time
        per_week = runs.indicators["violating_share"] * samples_per_week
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
        for case_runs in self.case_runs.values():
            rows += case_runs.rows()
        table = pd.DataFrame(rows, columns=RUN_COLUMNS)
        # A controller has no training seed, of which a plain integer column could not be empty.
        return table.astype({"training_seed": "Int64"})

    @cached_property
    def summary(self) -> pd.DataFrame:
        """A row for each scenario and case, the least median J first.

        The median regret is that of the middle run, or of the mean of both middle ones.
        """
        rows: list[dict[str, Any]] = []
        for scenario in self.scenarios:
            rows += self._summary_rows(scenario)
        table = pd.DataFrame(rows, columns=SUMMARY_COLUMNS)
        # What was trained once has no rank.
        return table.astype({"rank": "Int64"})

    def _summary_rows(self, scenario: str) -> list[dict[str, Any]]:
        """Rows of the summary on a scenario, the least median J first."""
        rows = []
        for case in self.cases:
            runs = self.case_runs.get((scenario, case))
            # Of a case that has not run, or not here, there is no row.
            if runs is not None:
                rows.append(runs.summary() | self._difference(runs))
        rows.sort(key=lambda row: float(row["J_median"]))
        by_cost = [self.case_runs[scenario, row["case"]] for row in rows]
        ranks = _ranks(by_cost)
        for row in rows:
            row["rank"] = ranks[row["case"]]
        return rows

    def _difference(self, runs: CaseRuns) -> dict[str, Any]:
        """Columns of the paired difference from a case's counterpart; NaN without it or J*."""
        name = self.cases[runs.case].get("against") or ""
        counterpart = self.case_runs.get((runs.scenario, name))
        # A counterpart may not run on this scenario.
        if counterpart is None:
            columns = columns_of("difference", Estimate(np.nan)) | {"difference_p": np.nan}
        else:
            columns = runs.difference_from(counterpart)
        return {"against": name or None, **columns}

    @cached_property
    def aggregate(self) -> pd.DataFrame:
        """Regret over all runs of cases that ran on all (several) scenarios with known J*.

        The bootstrap is stratified: runs are resampled within their scenario.
        """
        scenarios = []
        for scenario in self.scenarios:
            if self.reference("optimum", scenario) is not None:
                scenarios.append(scenario)
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
        runs_here = runs[runs.scenario == scenario]
        greedy_here = greedy[greedy.scenario == scenario]
        optimum = self.about["optimum"].get(scenario, "")
        return operation_result(runs_here, greedy_here, optimum)

    def operation_layout(self, scenario: str) -> OperationLayout:
        """Layout of tables and figure of a scenario in operation."""
        about = self.about["operation"][scenario]
        changes = {}
        # Only of a plant that changes: most do not.
        for change in about.get("changes", []):
            changes[int(change["sample"])] = change["parameters"]
        return OperationLayout(
            sampling_time=about["sampling_time"],
            columns=about["columns"],
            drawn=about["drawn"],
            changes=changes,
        )

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
        seeds = runs.training_seed.astype(str)
        # As `Run` writes its name.
        names = runs.case + f" on {scenario}, seed " + seeds

        def key_at_the_end(name: str) -> str:
            return timing_key(name, last_mark)

        keys = names.map(key_at_the_end)
        seconds = keys.map(timing.training_seconds)
        median_of_case = seconds.groupby(runs.case).median()
        return dict(median_of_case)


def _ranks(by_cost: Sequence[CaseRuns]) -> dict[str, int | None]:
    """Ranks of cases on one scenario, given in the order of their median J; None: unknown."""
    runs_of = {runs.case: runs for runs in by_cost}
    trained_once = [runs.case for runs in by_cost if runs.is_trained_once]

    def is_worse(case: str, leader: str) -> bool:
        return runs_of[case].costs_more_than(runs_of[leader])

    return shared_ranks(list(runs_of), trained_once, is_worse)


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
