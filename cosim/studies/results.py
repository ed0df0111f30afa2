"""Results of a study: its tables, their summaries, figures and report."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cosim.core import statistics
from cosim.core.errors import FailedRunsError, StudyError
from cosim.core.files import read_json, staged, write_atomically
from cosim.core.processes import holding
from cosim.core.protocols import Array
from cosim.core.result import Shown, TextTable, markdown_table
from cosim.core.simulation import reporting
from cosim.core.statistics import Estimate, over_runs, paired_difference, shown, two_way
from cosim.core.training_options import LOG
from cosim.core.validation import instead
from cosim.evaluation import EVALUATION, TIMING, Progress
from cosim.figures.style import FORMATS, DotRow, LineStyle, palette, save_set
from cosim.studies import figures, operation, report
from cosim.studies.plan import BASELINES, NAIVE, Study, StudyPlan, plan
from cosim.studies.ranks import shared_ranks
from cosim.studies.report import NEAR, PAPER, REPORT_COLUMNS, SHORT_COLUMNS
from cosim.studies.run import (
    GREEDY,
    INDICATORS,
    Runner,
    RunStore,
    folder_name,
    frame_csv,
    read_table,
    typed,
)

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
    OPERATION: [*RUN_KEYS, "samples", *operation.OPERATION_METRICS],
    GREEDY: [*RUN_KEYS, "samples", "seed", "J"],
}
"""Columns of the tables that runs give; `RAW_TABLES` are those of every study."""
CASE_FIELDS = ("name", "group", "samples", "nmpc", "settings", "scenarios", "start", "target")
"""What study.json says of a case as it is."""
MOST_LEVELS = 4
"""Baselines that are lines in a figure of curves, at most."""

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
class StudyResults(Shown):
    """Measurements of a study in `folder`, as pandas frames of its finished runs.

    `about` is the document study.json: cases, scenarios, and the versions that made them.
    `state` has a row for each run: scenario, case, training_seed, status, samples, plant_samples.
    `evaluation` has one for each run and noise seed. `curves` has one for each row of a training's
    log and one, without samples, for each controller on the noise of the curves.
    """

    folder: Path
    about: Mapping[str, Any]
    state: pd.DataFrame
    evaluation: pd.DataFrame
    curves: pd.DataFrame

    @classmethod
    def load(cls, folder: str | Path) -> StudyResults:
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
        tables = {name: read_table(folder / name, MEASURED_COLUMNS[name]) for name in RAW_TABLES}
        return cls(folder, about, *tables.values())

    @classmethod
    def write(
        cls, plan: StudyPlan, out: Path, stores: Iterable[RunStore], *, draw: bool = True
    ) -> StudyResults:
        """Write the tables and kept files of a plan's finished runs, study.json last.

        Args:
            plan: the study's plan.
            out: folder of the study.
            stores: what is there of each run.
            draw: whether the kept trajectories and logs are drawn.
        """
        _keep_files(plan, out)
        tables = _measured(_in_the_studys_order(plan, stores))
        about = document(plan)
        about["pictures"] = figures.draw_kept(plan, out) if draw else []
        results = cls(out, about, *(tables[name] for name in RAW_TABLES))
        if not about.get("operation"):
            del tables[OPERATION], tables[GREEDY]
        tables[RUNS_TABLE] = results.runs
        tables[SUMMARY] = results.summary
        tables[TIMING] = _timing(stores)
        if len(results.aggregate):
            tables[AGGREGATE] = results.aggregate
        with staged(out, STUDY_FILES) as stage:
            for name, table in tables.items():
                (stage / name).write_text(frame_csv(table), "utf-8")
            text = json.dumps(about, indent=1, sort_keys=True) + "\n"
            (stage / ABOUT).write_text(text, "utf-8")
        return results

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

    @cached_property
    def _indicators(self) -> dict[tuple[str, str], dict[str, Array]]:
        """Indicators (R, S) of the runs on the noise seeds, by scenario and case."""
        indicators: dict[tuple[str, str], dict[str, Array]] = {}
        rows = self.state[RUN_KEYS].merge(self.evaluation, on=RUN_KEYS, how="left")
        n_runs = self.state.groupby(WHERE).size()
        for where, measured in rows.groupby(WHERE, sort=False):
            # A run without a row has no seed; runs of unlike seeds do not fill a rectangle.
            if measured.seed.isna().any() or len(measured) % n_runs[where]:
                raise StudyError(f"the tables in '{self.folder}' are damaged: {where}")
            shape = (n_runs[where], -1)
            indicators[where] = {}
            for name in INDICATORS:
                values = measured[name].to_numpy(dtype=np.float64)
                indicators[where][name] = values.reshape(shape)
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
        measured = self._indicators.get((scenario, case))
        return np.zeros((0, 0)) if measured is None else measured[name]

    def runs_of(self, case: str, scenario: str) -> pd.DataFrame:
        """The case's rows of `runs` on a scenario, by training seed."""
        return self.runs[(self.runs.scenario == scenario) & (self.runs.case == case)]

    def reference(self, kind: str, scenario: str) -> Array | None:
        """J (S,) of a scenario's `optimum` or `naive`, or None."""
        cost = self.indicator(self.about[kind].get(scenario, ""), scenario)
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
        cost = self.indicator(case, scenario)[list(runs)].mean(axis=0)
        return statistics.regret(cost, best)

    def gap_closed(self, case: str, scenario: str, runs: Sequence[int] = (0,)) -> Estimate:
        """Share (J_naive − J)/(J_naive − J*) of the mean of some runs; arguments as of `regret`."""
        best = self.reference("optimum", scenario)
        naive = self.reference("naive", scenario)
        if best is None or naive is None:
            return Estimate(np.nan)
        cost = self.indicator(case, scenario)[list(runs)].mean(axis=0)
        return statistics.gap_closed(cost, naive, best)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """A row for each run: its state, J, regret with its interval over noise, indicators."""
        rows = []
        for (scenario, case), states in self.state.groupby(WHERE, sort=False):
            indicators = self._indicators[scenario, case]
            for run, row in enumerate(states.to_dict("records")):
                regret = self.regret(case, scenario, [run])
                row.update(_columns("regret", regret))
                for name in ("J", *AGGREGATED_MEANS):
                    values = indicators[name][run]
                    row[name] = float(values.mean())
                # The mean cost of a run that diverged may be NaN.
                if not np.isfinite(row["J"]):
                    row["J"] = np.inf
                row["gap_closed"] = self.gap_closed(case, scenario, [run]).value
                row["failures"] = int(indicators["failures"][run].sum())
                rows.append(row)
        return pd.DataFrame(rows, columns=RUN_COLUMNS).astype({"training_seed": "Int64"})

    @cached_property
    def summary(self) -> pd.DataFrame:
        """A row for each scenario and case, the least median J first.

        The median regret is that of the middle run, or of the mean of both middle ones.
        """
        rows: list[dict[str, Any]] = []
        for scenario in self.scenarios:
            of_scenario = []
            for case in self.cases:
                if len(self.indicator(case, scenario)):
                    of_scenario.append(self._summary_row(case, scenario))
            of_scenario.sort(key=lambda row: float(row["J_median"]))
            ranks = self._ranks(scenario, [row["case"] for row in of_scenario])
            for row in of_scenario:
                row["rank"] = ranks[row["case"]]
            rows += of_scenario
        return pd.DataFrame(rows, columns=SUMMARY_COLUMNS).astype({"rank": "Int64"})

    def _summary_row(self, case: str, scenario: str) -> dict[str, Any]:
        """A case's row of the summary, but for its rank."""
        runs = self.runs_of(case, scenario)
        cost = runs.J.to_numpy()
        by_cost = np.argsort(cost, kind="stable")
        regrets = self.regrets(case, scenario)[by_cost]
        # The middle run, or both middle ones.
        middle = list(by_cost[(len(cost) - 1) // 2 : len(cost) // 2 + 1])
        iqm = over_runs([regrets]) if len(runs) > 1 else Estimate(regrets[0])
        row: dict[str, Any] = {
            "scenario": scenario,
            "case": case,
            "samples": runs.samples.max(),
            "plant_samples": runs.plant_samples.max(),
            "finished": int((~runs.status.str.startswith("diverged")).sum()),
            "runs": len(runs),
            "regret_worst": float(regrets[-1]),
            "J_median": float(np.median(cost)),
            "J_worst": float(cost[by_cost[-1]]),
            "J_iqm": over_runs([cost[by_cost]]).value,
            "gap_closed_median": self.gap_closed(case, scenario, middle).value,
            "failures": int(self.indicator(case, scenario, "failures").sum()),
        }
        row.update(_columns("regret_median", self.regret(case, scenario, middle)))
        row.update(_columns("regret_iqm", iqm))
        for name in AGGREGATED_MEANS:
            row[name] = float(np.median(runs[name]))
        row.update(self._comparisons(case, scenario))
        return row

    def _comparisons(self, case: str, scenario: str) -> dict[str, Any]:
        """Columns of the summary that need J*: the wide interval, and the paired difference."""
        best = self.reference("optimum", scenario)
        other = self.cases[case].get("against")
        wide_interval = None
        difference = Estimate(np.nan)
        p = np.nan
        if best is not None and not self._single(case, scenario):
            wide_interval = two_way(self.indicator(case, scenario), best)
        if best is not None and other is not None and len(self.indicator(other, scenario)):
            cost, other_cost = self._pairs(case, other, scenario)
            value, interval, p = paired_difference(cost, other_cost, best)
            difference = Estimate(value, interval)
        return {
            **_columns("regret_wide", Estimate(np.nan, wide_interval)),
            "against": other,
            **_columns("difference", difference),
            "difference_p": p,
        }

    def _single(self, case: str, scenario: str) -> bool:
        """Whether a case has one training only, so that its spread is unknown."""
        return bool(self.cases[case]["trained"]) and len(self.indicator(case, scenario)) < 2

    def _pairs(self, case: str, other: str, scenario: str) -> tuple[Array, Array]:
        """J (R, S) of two cases over the training seeds that both have; a controller has any."""
        cost = self.indicator(case, scenario)
        other_cost = self.indicator(other, scenario)
        seeds = self.runs_of(case, scenario).training_seed
        other_seeds = self.runs_of(other, scenario).training_seed
        if seeds.notna().all() and other_seeds.notna().all():
            # Runs are in the order of their training seeds.
            cost = cost[seeds.isin(other_seeds).to_numpy()]
            other_cost = other_cost[other_seeds.isin(seeds).to_numpy()]
        # A controller has one row, which is compared with each run.
        pair = np.broadcast_arrays(cost, other_cost)
        return pair[0], pair[1]

    def _ranks(self, scenario: str, cases: Sequence[str]) -> dict[str, int | None]:
        """Ranks of cases on a scenario, given in the order of their median J."""

        def is_worse(case: str, leader: str) -> bool:
            cost, leader_cost = self._pairs(case, leader, scenario)
            # Without a training seed in common nothing is known.
            if not len(cost):
                return False
            best = self.reference("optimum", scenario)
            if best is None:
                best = leader_cost.mean(axis=0)
            interval = paired_difference(cost, leader_cost, best)[1]
            return interval is not None and interval[0] > 0

        trained_once = [case for case in cases if self._single(case, scenario)]
        return shared_ranks(cases, trained_once, is_worse)

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
        sampling_time = self._sampling_time(scenario)
        if sampling_time is None or not share.size:
            return Estimate(np.nan)
        per_week = share * operation.WEEK / sampling_time
        ones = np.ones(per_week.shape[1])
        interval = two_way(per_week, ones, np.zeros_like(per_week))
        return Estimate(float(np.median(per_week.mean(axis=1))), interval)

    def _sampling_time(self, scenario: str) -> float | None:
        """Sampling time in s; None in studies that an earlier version stored."""
        times: Mapping[str, float] = self.about.get("sampling_times", {})
        if scenario in times:
            return times[scenario]
        in_operation = self.about.get("operation") or {}
        if scenario in in_operation:
            return float(in_operation[scenario]["sampling_time"])
        return None

    def regrets(self, case: str, scenario: str) -> Array:
        """Regret (R,) of each run; infinite if J is not finite, NaN if J* is unknown."""
        runs = self.runs_of(case, scenario)
        if self.reference("optimum", scenario) is None:
            return np.full(len(runs), np.nan)
        return np.where(np.isfinite(runs.J), runs.regret, np.inf)

    @cached_property
    def aggregate(self) -> pd.DataFrame:
        """Regret over all runs of cases that ran on all (several) scenarios with known J*.

        The bootstrap is stratified: runs are resampled within their scenario.
        """
        scenarios = [name for name in self.scenarios if self.reference("optimum", name) is not None]
        rows: list[dict[str, Any]] = []
        for case in self.cases if len(scenarios) > 1 else ():
            strata = [self.regrets(case, scenario) for scenario in scenarios]
            if not all(len(regrets) for regrets in strata):
                continue
            all_regrets = np.concatenate(strata)
            row = {
                "case": case,
                "scenarios": len(strata),
                "runs": len(all_regrets),
                "regret_median": np.median(all_regrets),
                "regret_worst": all_regrets.max(),
            }
            row.update(_columns("regret_iqm", over_runs(strata)))
            rows.append(row)
        rows.sort(key=lambda row: float(row["regret_iqm"]))
        return pd.DataFrame(rows, columns=AGGREGATE_COLUMNS)

    def to_pandas(self) -> pd.DataFrame:
        """A copy of `runs`, a row for each run."""
        return self.runs.copy()

    def lines(
        self, scenario: str, columns: Sequence[str] | None = None
    ) -> tuple[Sequence[str], list[list[str]]]:
        """Header and rows of a scenario's table as texts.

        Args:
            scenario: its name.
            columns: keys of `REPORT_COLUMNS`; by default all, the last three only where a case
                has a counterpart.

        Raises:
            StudyError: there is no such column.
        """
        if columns is None:
            columns = list(REPORT_COLUMNS)
            if not any(case.get("against") for case in self.cases.values()):
                columns = columns[:-3]
            if self._sampling_time(scenario) is None:
                columns.remove("week")
        for name in columns:
            if name not in REPORT_COLUMNS:
                raise StudyError(f"a table has no column '{name}'{instead(name, REPORT_COLUMNS)}")
        rows = self.summary[self.summary.scenario == scenario].to_dict("records")
        for row in rows:
            row.update(self._further_intervals(row))
        return report.texts(rows, dict(REPORT_COLUMNS[name] for name in columns))

    def _further_intervals(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """What a printed row shows beside its columns of the summary."""
        case = row["case"]
        scenario = row["scenario"]
        # Of one training the interval is over the noise alone.
        kind = "regret_median" if self._single(case, scenario) else "regret_wide"
        runs = self.runs_of(case, scenario)
        worst = runs.iloc[int(np.argmax(runs.J))]
        return {
            "regret_shown_low": row[f"{kind}_low"],
            "regret_shown_high": row[f"{kind}_high"],
            "regret_worst_low": worst.regret_low,
            "regret_worst_high": worst.regret_high,
            **_columns("violations_week", self.violations_per_week(case, scenario)),
        }

    def table(self, scenario: str | None = None) -> str:
        """A scenario's table as Markdown, lowest J first; None: the tables of all scenarios."""
        if scenario is not None:
            return markdown_table(*self.lines(scenario))
        return "\n".join(f"{name}\n\n{self.table(name)}" for name in self.scenarios)

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

    def further_tables(self) -> Iterator[TextTable]:
        """Title, header and rows of the tables that the study asks for beside its summary."""
        against = {name: case.get("against") for name, case in self.cases.items()}
        for scenario in self.about.get("operation") or {}:
            result = self._operation_result(scenario)
            seconds = self._processor_seconds(scenario)
            layout = self._operation_layout(scenario)
            yield from operation.operation_tables(result, scenario, layout, against, seconds)
        if "paper" in self.about["tables"]:
            yield self.paper()

    def paper(self) -> TextTable:
        """Title, header and rows: gains of each trained case's median run on every scenario.

        The paper's two gains imply J(b)/J(a) = (1 − 0.21)/(1 − 0.15) = 0.93.
        """
        rows = []
        trained = [name for name, case in self.cases.items() if case["trained"]]
        for scenario, case in product(self.scenarios, trained):
            indicators = self._indicators.get((scenario, case))
            bases = []
            for name in PAPER:
                if (scenario, name) in self._indicators:
                    bases.append(self._indicators[scenario, name])
            if indicators is None or len(bases) < len(PAPER):
                continue
            gains = _gains_over_baselines(indicators, bases)
            rows.append([scenario, case, *gains])
        said = "the paper's text states about 21 % over (a) and 15 % over (b)"
        header = (
            "scenario", "case", "J(b)/J(a)", "J, median", "gain over (a) %", "gain over (b) %",
            "economic over (a) %", "economic over (b) %", "agrees with the paper on",
        )  # fmt: skip
        return f"Gains over the baselines: {said}", header, rows

    def figure(self, name: str | None = None) -> Figure:
        """Draw `curves`, `regret` or `operation` of a scenario, as `curves-paper`.

        None is the first scenario's regret. Raises StudyError for another name, and where there is
        nothing to draw.
        """
        if name is None:
            name = f"regret-{self.scenarios[0]}"
        names = [f"{kind}-{where}" for where, kind in product(self.scenarios, self._makers)]
        drawn = None
        if name in names:
            kind, _, scenario = name.partition("-")
            drawn = self._makers[kind](scenario)
        if drawn is None:
            raise StudyError(f"this study draws no figure '{name}'{instead(name, names)}")
        return drawn

    @property
    def _makers(self) -> dict[str, Callable[[str], Figure | None]]:
        return {"curves": self._curves, "regret": self._regret, "operation": self._operation}

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
            for kind, maker in self._makers.items():
                figure = maker(scenario)
                if figure is not None:
                    drawn.append((f"{kind}-{folder_name(scenario)}", figure))
            names[scenario] = save_set(drawn, folder, formats)
        return names

    @property
    def _styles(self) -> dict[str, LineStyle]:
        return palette(list(self.cases), self.scenarios)

    def _regret(self, scenario: str) -> Figure | None:
        """Regrets of all runs; None where J* is unknown."""
        if self.reference("optimum", scenario) is None:
            return None
        dots = []
        for row in self.summary[self.summary.scenario == scenario].to_dict("records"):
            case = str(row["case"])
            if case == self.about["optimum"][scenario]:
                continue
            kind = "regret_iqm" if row["runs"] > 1 else "regret_median"
            diverged = self.runs_of(case, scenario).status.str.startswith("diverged").to_numpy()
            dots.append(
                DotRow(
                    case,
                    values=100 * self.regrets(case, scenario),
                    finished=~diverged,
                    middle=100 * row[kind],
                    low=100 * row[f"{kind}_low"],
                    high=100 * row[f"{kind}_high"],
                )
            )
        return figures.regret_figure(dots, self._styles) if dots else None

    def _curves(self, scenario: str) -> Figure | None:
        """Learning curves; None if no training was evaluated more than once."""
        rows = self.curves[self.curves.scenario == scenario]
        is_training = rows.training_seed.notna()
        trained = rows[is_training]
        evaluated = trained.dropna(subset="greedy_J").groupby(RUN_KEYS).greedy_J
        learned = trained[~trained.case.isin(self.baselines)].groupby("case", sort=False)
        if not (evaluated.size() > 1).any() or not len(learned):
            return None
        controllers = rows[~is_training].set_index("case").greedy_J
        best = float(controllers.get(self.about["optimum"].get(scenario), np.nan))
        is_known = bool(np.isfinite(best))
        curves = {}
        for case, log in learned:
            curves[str(case)] = figures.learning_curve(log, best if is_known else None)
        at_the_end = evaluated.last().groupby("case").median()
        levels = self._levels(scenario, controllers, at_the_end)
        if is_known:
            levels[:] = 100 * statistics.regrets(levels.to_numpy(), best)
        return figures.curves_figure(
            curves,
            {str(name): float(cost) for name, cost in levels.items()},
            self._styles,
            relative=is_known,
        )

    def _levels(self, scenario: str, controllers: pd.Series, trained: pd.Series) -> pd.Series:
        """Greedy costs of the baselines that a figure of curves shows as lines, by name.

        Args:
            scenario: its name.
            controllers: greedy cost of each controller, by name.
            trained: median greedy cost of each trained case at its end, by name.
        """
        costs = pd.concat([controllers, trained])
        # The optimum is where a regret is 0, and no line.
        is_baseline = costs.index.isin(self.baselines)
        is_optimum = costs.index == self.about["optimum"].get(scenario)
        costs = costs[is_baseline & ~is_optimum & np.isfinite(costs)]
        costs = costs.sort_values(kind="stable")
        # Naive is kept, be it the worst: it is where the curves begin.
        naive = self.about["naive"].get(scenario)
        names = [name for name in costs.index if name == naive]
        names += [name for name in costs.index if name != naive]
        return costs[names[:MOST_LEVELS]]

    def _operation_result(self, scenario: str) -> operation.OperationResult:
        """Regrets of the runs in operation on a scenario."""
        runs = read_table(self.folder / OPERATION, needed=["samples"])
        # A table that an earlier version stored lacks the latest columns.
        runs = runs.reindex(columns=MEASURED_COLUMNS[OPERATION])
        greedy = read_table(self.folder / GREEDY, MEASURED_COLUMNS[GREEDY])
        return operation.operation_result(
            runs[runs.scenario == scenario],
            greedy[greedy.scenario == scenario],
            self.about["optimum"].get(scenario, ""),
        )

    def _operation_layout(self, scenario: str) -> operation.OperationLayout:
        about = self.about["operation"][scenario]
        return operation.OperationLayout(about["sampling_time"], about["columns"], about["drawn"])

    def _processor_seconds(self, scenario: str) -> dict[str, float]:
        """Median processor time in s of a case's runs, up to their last sample."""
        path = self.folder / TIMING
        if not path.is_file():
            return {}
        clock = read_table(path, needed=["run"]).set_index("run")
        last = self.about["operation"][scenario]["columns"][-1]
        is_training = self.state.training_seed.notna()
        runs = self.state[(self.state.scenario == scenario) & is_training]
        # The table names a run as `Run` does, and the mark behind it.
        seeds = runs.training_seed.astype(str)
        names = runs.case + f" on {scenario}, seed " + seeds + f", sample {last}"
        seconds = names.map(clock.training_seconds)
        return dict(seconds.groupby(runs.case).median())

    def _operation(self, scenario: str) -> Figure | None:
        """Regret in operation; None where there is no course to draw."""
        if scenario not in (self.about.get("operation") or {}):
            return None
        result = self._operation_result(scenario)
        if result.runs.samples.nunique() == 1:
            return None
        layout = self._operation_layout(scenario)
        return figures.operation_figure(result, layout, self._styles, self.baselines)

    def report(self) -> Path:
        """Write report.html, report.md and figures/ into the study's folder; returns the page."""
        folder = self.folder / report.FOLDER
        drawn = self.draw(folder)
        page = self._page(drawn)

        def picture(name: str) -> dict[str, str] | None:
            path = folder / f"{name}.svg"
            # Those of a stored study's single runs are there once `cosim results draw` drew them.
            return report.image(path) if path.is_file() else None

        for name in (report.MARKDOWN, report.PAGE):
            text = report.rendered(name, **page, picture=picture)
            write_atomically(self.folder / name, text)
        return self.folder / report.PAGE

    def _page(self, drawn: Mapping[str, list[str]]) -> dict[str, Any]:
        """The report, for its templates.

        A section has a title and may have a note, a table, and names of figures in `figures`.
        """
        sections: list[dict[str, Any]] = []
        for name in self.scenarios:
            sections.append(
                {
                    "title": f"Scenario {name}",
                    "note": self._noise_note(name),
                    "table": self.lines(name),
                    "figures": drawn[name],
                }
            )
        if len(self.aggregate):
            table = report.texts(self.aggregate.to_dict("records"), report.AGGREGATE_TEXTS)
            sections.append({"title": "All scenarios", "table": table})
        for title, header, rows in self.further_tables():
            sections.append({"title": title, "table": (header, rows)})
        if self.about["pictures"]:
            sections.append({"title": "Sample by sample", "figures": self.about["pictures"]})
        table = report.texts(self.cases.values(), report.CASES)
        sections.append({"title": "Cases", "table": table})
        made_with = self.about["made_with"]
        made = f"Made with {made_with['versions']}; code {made_with['code_hash']}"
        if made_with.get("commit"):
            made += f"; commit {made_with['commit']}"
        return {
            "title": self.about["title"] or self.name,
            "description": self.about["description"],
            "runs": len(self.state),
            "missing": self.about["runs"] - len(self.state),
            "sections": sections,
            "every": report.texts(self.runs.to_dict("records"), report.EVERY_RUN),
            "command": ["cosim", "study", "run", self.about.get("file") or f"{self.name}.toml"],
            "made": made,
            "date": report.date(self.folder / TIMING),
        }

    def _noise_note(self, scenario: str) -> str:
        """The noise that a scenario's figures were measured on, in words."""
        rows = self.evaluation[self.evaluation.scenario == scenario]
        if rows.empty:
            return "No run is finished."
        note = (
            f"Table and regret: {rows.seed.nunique()} noise seeds × {rows.steps.iloc[0]} samples."
        )
        if scenario not in self.about["curves"]:
            return note
        seeds, steps = self.about["curves"][scenario]
        return (
            f"{note} Learning curves: {seeds} other seeds × {steps} samples. Regrets of a case "
            "differ between the two."
        )


def _columns(name: str, estimate: Estimate) -> dict[str, float]:
    """An estimate as columns of a table: its value, and the ends of its interval or NaN."""
    low, high = estimate.interval or (np.nan, np.nan)
    return {name: estimate.value, f"{name}_low": low, f"{name}_high": high}


def _gains_over_baselines(
    indicators: Mapping[str, Array], bases: Sequence[Mapping[str, Array]]
) -> list[str]:
    """Cells of the paper's table: what a case's median run gains over (a) and (b).

    Args:
        indicators: of the case, (R, S) each.
        bases: indicators of the controllers (a) and (b), (1, S) each.
    """
    naive, tuned = bases
    cost = indicators["J"].mean(axis=1)
    by_cost = np.argsort(cost, kind="stable")
    # Of an even number the lower one of both middle runs.
    middle = by_cost[(len(cost) - 1) // 2]
    ratio = tuned["J"].mean() / naive["J"].mean()
    cells = [f"{ratio:.3f}", shown(float(cost[middle]), digits=6)]
    for name in ("J", "economic_cost"):
        for base in bases:
            gain = statistics.gain(indicators[name][middle], base[name][0])
            cells.append(shown(gain.value, gain.interval, 100.0, 3))
    agrees = []
    for letter, base, of_the_paper in zip("ab", bases, PAPER.values(), strict=True):
        gain = statistics.gain(indicators["J"][middle], base["J"][0])
        if abs(100 * gain.value - of_the_paper) <= NEAR:
            agrees.append(f"({letter})")
    return [*cells, " and ".join(agrees)]


def _in_the_studys_order(plan: StudyPlan, stores: Iterable[RunStore]) -> list[RunStore]:
    """The finished runs by scenario, case and training seed."""
    cases = [case.name for case in plan.definition.all_cases]
    places = {where: i for i, where in enumerate(product(plan.definition.scenarios, cases))}
    finished = [store for store in stores if store.complete]  # by training seed
    return sorted(finished, key=lambda store: places[store.run.scenario.name, store.run.case])


def _keep_files(plan: StudyPlan, out: Path) -> None:
    """Copy the files that the study keeps of its runs to where it keeps them."""
    for run in plan.runs:
        for name, target in run.kept.items():
            source = out / run.folder / name
            if source.is_file():
                (out / target).parent.mkdir(parents=True, exist_ok=True)
                write_atomically(out / target, source.read_bytes())


def _measured(stores: Iterable[RunStore]) -> dict[str, pd.DataFrame]:
    """The tables `MEASURED_COLUMNS` of finished runs.

    In operation the optimum has a run on the noise of every training seed, of which J is known.
    """
    parts: dict[str, list[pd.DataFrame]] = {name: [] for name in MEASURED_COLUMNS}
    for store in stores:
        run = store.run
        key = {"scenario": run.scenario.name, "case": run.case, "training_seed": run.seed}
        # A controller is not trained, and has no status of its own.
        state = {
            "status": store.status or "evaluated",
            "samples": int(store.about.get("samples", 0)),
            "plant_samples": int(store.about.get("plant_samples", 0)),
        }
        parts[RUNS_TABLE].append(pd.DataFrame([key | state]))
        if run.training is not None:
            log = read_table(store.folder / LOG).assign(**key)
            parts[CURVES].append(log)
            if run.training.marks:
                parts[OPERATION].append(log)
        online = []
        for file, noise in run.noise.items():
            # A trajectory is kept as a file, not as rows of a table.
            if noise.whole:
                continue
            rows = store.measured(file).rename_axis("seed").reset_index()
            if file in run.marks:
                parts[GREEDY].append(rows.assign(**key, samples=run.marks[file]))
            elif file == GREEDY:
                mean = key | {"greedy_J": float(rows.J.mean())}
                parts[CURVES].append(pd.DataFrame([mean]))
            elif file == EVALUATION:
                parts[EVALUATION].append(rows.assign(**key, steps=noise.steps))
            else:
                # A run of the optimum for each training seed, as long as a mark.
                of_the_optimum = key | {"training_seed": rows.seed, "samples": noise.steps}
                online.append(rows[["J"]].assign(**of_the_optimum))
        if online:
            parts[OPERATION].append(pd.concat(online).sort_values(["training_seed", "samples"]))
    tables = {}
    for name, columns in MEASURED_COLUMNS.items():
        rows = pd.concat(parts[name] or [pd.DataFrame()], ignore_index=True)
        tables[name] = typed(rows.reindex(columns=columns))
    return tables


def _timing(stores: Iterable[RunStore]) -> pd.DataFrame:
    """Seconds that each run's training took; in operation the processor's up to each mark, too."""
    rows = []
    for store in stores:
        clock = store.about.get("timing", {})
        name = str(store.run)
        wall_seconds = float(clock.get("wall_seconds", 0.0))
        rows.append({"run": name, "training_seconds": wall_seconds})
        at_marks: Mapping[str, float] = clock.get("processor_seconds", {})
        for mark, seconds in at_marks.items():
            rows.append({"run": f"{name}, sample {mark}", "training_seconds": float(seconds)})
    return pd.DataFrame(rows, columns=["run", "training_seconds"])


def document(plan: StudyPlan) -> dict[str, Any]:
    """The document study.json of a plan."""
    definition = plan.definition
    scenarios = list(definition.scenarios)
    cases = []
    for case in definition.all_cases:
        about_case = {name: getattr(case, name) for name in CASE_FIELDS}
        about_case["trained"] = case.algorithm is not None
        about_case["against"] = definition.counterpart(case)
        cases.append(about_case)
    curves = {}
    for name in scenarios if definition.has_curves else ():
        noise = definition.held_out(name)
        curves[name] = [len(noise.seeds), noise.steps]
    about = {
        "schema": SCHEMA,
        "name": definition.name,
        "title": definition.table.title,
        "description": definition.table.description,
        "scenarios": scenarios,
        "cases": cases,
        "file": Path(definition.file).name if definition.file else None,
        "optimum": definition.optima,
        "naive": dict.fromkeys(scenarios, definition.named(NAIVE)),
        "curves": curves,
        "sampling_times": {
            name: scenario.sampling_time for name, scenario in definition.scenarios.items()
        },
        "runs": len(plan.runs),
        "tables": list(definition.table.tables),
        "made_with": dict(plan.provenance) | {"commit": report.commit()},
    }
    trains = any(case.algorithm for case in definition.cases)
    table = definition.table.operation
    if table is not None and trains:
        in_operation = {}
        for name, scenario in definition.scenarios.items():
            marks = definition.marks(name)
            columns = [m for m in definition.samples_of(table.columns, name) if m in marks]
            in_operation[name] = {
                "sampling_time": scenario.sampling_time,
                "marks": marks,
                "columns": columns or marks,
                "drawn": table.drawn,
            }
        about["operation"] = in_operation
    # As it is when it is read again: tuples are lists.
    return dict(json.loads(json.dumps(about)))


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
    with holding(folder), reporting(progress, definition.name, planned.samples) as tell:
        runner = Runner(planned.runs, folder, tell)
        for line in runner.remarks:
            tell(0, "", line)
        runner.run(jobs, scheduler)
        results = StudyResults.write(planned, folder, runner.stores.values(), draw=figures)
    if runner.failures:
        name, failure = next(iter(runner.failures.items()))
        more = len(runner.failures) - 1
        others = f" ({more} more failed)" if more else ""
        raise FailedRunsError(f"{name}: {failure.message}{others}; run again to try anew")
    return results
