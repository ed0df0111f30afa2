"""Measurements of a study: frames of runs, evaluations and curves, and all that is made of them."""

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
from cosim.core.validation import instead
from cosim.evaluation import EVALUATION, TIMING, Progress
from cosim.figures.style import FORMATS, DotRow, LineStyle, palette, save_set
from cosim.studies import figures, operation, report
from cosim.studies.plan import BASELINES, NAIVE, Plan, Study, plan
from cosim.studies.report import COLUMNS, NEAR, PAPER, SHORT
from cosim.studies.run import (
    GREEDY,
    INDICATORS,
    LOG,
    Runner,
    RunStore,
    read_table,
    safe,
    to_csv,
    typed,
)

ABOUT, SCHEMA = "study.json", 1
CURVES, RUNS, SUMMARY, AGGREGATE = "curves.csv", "runs.csv", "summary.csv", "aggregate.csv"
TABLES, OPERATION = (RUNS, EVALUATION, CURVES), "operation.csv"
FILES = (*TABLES, SUMMARY, AGGREGATE, OPERATION, GREEDY, TIMING, ABOUT, "summary.json")
"""Files beside those of the runs; all in a folder belong to one study."""
WHERE = ["scenario", "case"]
KEYS = [*WHERE, "training_seed"]
STATE = [*KEYS, "status", "samples", "plant_samples"]
MEASURED = {
    RUNS: STATE,
    EVALUATION: [*KEYS, "seed", "steps", *INDICATORS],
    CURVES: [*KEYS, "samples", "J", "greedy_J", "td_error"],
    OPERATION: [*KEYS, "samples", *operation.LIFE],
    GREEDY: [*KEYS, "samples", "seed", "J"],
}
"""Columns of the tables that runs give; `TABLES` are those of every study."""
SAME = ("name", "group", "samples", "nmpc", "settings", "scenarios", "start", "target")
"""What study.json says of a case as it is."""
LEVELS = 4
"""Baselines that are lines in a figure of curves, at most."""

MEANS = ["economic_cost", "mean_violation", "violating_share"]
RUN_COLUMNS = [
    *STATE, "J", "regret", "regret_low", "regret_high", "gap_closed", *MEANS, "failures",
]  # fmt: skip
SUMMARY_COLUMNS = [
    *WHERE, "samples", "plant_samples", "finished", "runs", "regret_median",
    "regret_median_low", "regret_median_high", "regret_worst", "regret_iqm", "regret_iqm_low",
    "regret_iqm_high", "J_median", "J_worst", "J_iqm", "gap_closed_median", *MEANS, "failures",
    "regret_wide_low", "regret_wide_high", "rank", "against", "difference", "difference_low",
    "difference_high", "difference_p",
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
        tables = {name: read_table(folder / name, MEASURED[name]) for name in TABLES}
        return cls(folder, about, *tables.values())

    @classmethod
    def written(
        cls, planned: Plan, out: Path, stores: Iterable[RunStore], *, draw: bool = True
    ) -> StudyResults:
        """Write the tables and kept files of a plan's finished runs, study.json last.

        `draw` draws the kept trajectories and logs, too.
        """
        cases = [case.name for case in planned.definition.all_cases]
        places = {key: i for i, key in enumerate(product(planned.definition.scenarios, cases))}
        runs = [store for store in stores if store.sealed]  # by training seed
        runs.sort(key=lambda store: places[store.run.scenario.name, store.run.case])
        for run in planned.runs:
            for name, target in run.kept.items():
                if (source := out / run.folder / name).is_file():
                    (out / target).parent.mkdir(parents=True, exist_ok=True)
                    write_atomically(out / target, source.read_bytes())
        tables, about = _measured(runs), document(planned)
        about["pictures"] = figures.draw(planned, out) if draw else []
        found = cls(out, about, *(tables[name] for name in TABLES))
        if not about.get("operation"):
            del tables[OPERATION], tables[GREEDY]
        tables |= {RUNS: found.runs, SUMMARY: found.summary, TIMING: _timing(stores)}
        if len(found.aggregate):
            tables[AGGREGATE] = found.aggregate
        with staged(out, FILES) as stage:
            for name, table in tables.items():
                (stage / name).write_text(to_csv(table), "utf-8")
            text = json.dumps(about, indent=1, sort_keys=True) + "\n"
            (stage / ABOUT).write_text(text, "utf-8")
        return found

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
    def _arrays(self) -> dict[tuple[str, str], dict[str, Array]]:
        """Indicators (R, S) by scenario and case."""
        found: dict[tuple[str, str], dict[str, Array]] = {}
        rows = self.state[KEYS].merge(self.evaluation, on=KEYS, how="left")
        counts = self.state.groupby(WHERE).size()
        for where, own in rows.groupby(WHERE, sort=False):
            if own.seed.isna().any() or len(own) % counts[where]:
                raise StudyError(f"the tables in '{self.folder}' are damaged: {where}")
            values = own[[*INDICATORS]].to_numpy(dtype=np.float64).T
            arrays = np.ascontiguousarray(values).reshape(len(values), counts[where], -1)
            found[where] = dict(zip(INDICATORS, arrays, strict=True))
        return found

    def indicator(self, case: str, scenario: str, name: str = "J") -> Array:
        """An indicator of a case's runs over the noise seeds, (R, S); (0, 0) without runs."""
        own = self._arrays.get((scenario, case))
        return np.zeros((0, 0)) if own is None else own[name]

    def of(self, case: str, scenario: str) -> pd.DataFrame:
        """Rows of `runs` of a case on a scenario, by training seed."""
        return self.runs[(self.runs.scenario == scenario) & (self.runs.case == case)]

    def reference(self, kind: str, scenario: str) -> Array | None:
        """J (S,) of a scenario's `optimum` or `naive`, or None."""
        cost = self.indicator(self.about[kind].get(scenario, ""), scenario)
        return cost[0] if len(cost) else None

    def regret(self, case: str, scenario: str, runs: Sequence[int] = (0,)) -> Estimate:
        """(J − J*)/|J*| of the mean of `runs` (from 0), paired over noise seeds; NaN without J*."""
        best = self.reference("optimum", scenario)
        cost = self.indicator(case, scenario)[list(runs)].mean(axis=0)
        return Estimate(np.nan) if best is None else statistics.regret(cost, best)

    def gap_closed(self, case: str, scenario: str, runs: Sequence[int] = (0,)) -> Estimate:
        """(J_naive − J)/(J_naive − J*), likewise."""
        best, naive = (self.reference(kind, scenario) for kind in ("optimum", "naive"))
        if best is None or naive is None:
            return Estimate(np.nan)
        cost = self.indicator(case, scenario)[list(runs)].mean(axis=0)
        return statistics.gap_closed(cost, naive, best)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """A row for each run: its state, J, regret with its interval over noise, indicators."""
        rows = []
        for (scenario, case), state in self.state.groupby(WHERE, sort=False):
            own = self._arrays[scenario, case]
            for run, known in enumerate(state.to_dict("records")):
                row = known | _columns("regret", self.regret(case, scenario, [run]))
                row |= {name: float(own[name][run].mean()) for name in ("J", *MEANS)}
                row["J"] = row["J"] if np.isfinite(row["J"]) else np.inf
                row["gap_closed"] = self.gap_closed(case, scenario, [run]).value
                rows.append(row | {"failures": int(own["failures"][run].sum())})
        return pd.DataFrame(rows, columns=RUN_COLUMNS).astype({"training_seed": "Int64"})

    @cached_property
    def summary(self) -> pd.DataFrame:
        """A row for each scenario and case, the least median J first.

        The median regret is that of the middle run, or of the mean of both middle ones.
        """
        rows: list[dict[str, Any]] = []
        for scenario in self.scenarios:
            cases = [case for case in self.cases if len(self.indicator(case, scenario))]
            known = [self._summary(case, scenario) for case in cases]
            rows += self._ranked(scenario, sorted(known, key=lambda row: float(row["J_median"])))
        return pd.DataFrame(rows, columns=SUMMARY_COLUMNS)

    def _summary(self, case: str, scenario: str) -> dict[str, Any]:
        runs, own = self.of(case, scenario), self._arrays[scenario, case]
        cost, values = runs.J.to_numpy(), self.regrets(case, scenario)
        order = np.argsort(cost, kind="stable")
        middle = order[(len(order) - 1) // 2 : len(order) // 2 + 1]
        median = self.regret(case, scenario, list(middle))
        spread = over_runs([values[order]]) if len(runs) > 1 else Estimate(values[0])
        best, other = self.reference("optimum", scenario), self.cases[case].get("against")
        wide, difference, p = None, Estimate(np.nan), np.nan
        if best is not None and not self._single(case, scenario):
            wide = two_way(own["J"], best)
        if best is not None and other is not None and len(self.indicator(other, scenario)):
            value, ends, p = paired_difference(*self._pairs(case, other, scenario), best)
            difference = Estimate(value, ends)
        return {
            "scenario": scenario,
            "case": case,
            "samples": runs.samples.max(),
            "plant_samples": runs.plant_samples.max(),
            "finished": int((~runs.status.str.startswith("diverged")).sum()),
            "runs": len(runs),
            **_columns("regret_median", median),
            "regret_worst": float(values[order[-1]]),
            **_columns("regret_iqm", spread),
            "J_median": float(np.median(cost)),
            "J_worst": float(cost[order[-1]]),
            "J_iqm": over_runs([cost[order]]).value,
            "gap_closed_median": self.gap_closed(case, scenario, list(middle)).value,
            **{name: float(np.median(runs[name])) for name in MEANS},
            "failures": int(own["failures"].sum()),
            **_columns("regret_wide", Estimate(np.nan, wide)),
            "against": other,
            **_columns("difference", difference),
            "difference_p": p,
        }

    def _single(self, case: str, scenario: str) -> bool:
        """Whether a case has one training only, so that its spread is unknown."""
        return bool(self.cases[case]["trained"]) and len(self.indicator(case, scenario)) < 2

    def _pairs(self, case: str, other: str, scenario: str) -> tuple[Array, Array]:
        """J (R, S) of two cases over the training seeds that both have; a controller has any."""
        costs = [self.indicator(name, scenario) for name in (case, other)]
        seeds = [self.of(name, scenario).training_seed for name in (case, other)]
        if seeds[0].notna().all() and seeds[1].notna().all():
            common = sorted(set(seeds[0]) & set(seeds[1]))
            costs = [
                cost[[list(own).index(seed) for seed in common]]
                for cost, own in zip(costs, seeds, strict=True)
            ]
        one, two = np.broadcast_arrays(*costs)
        return one, two

    def _ranked(self, scenario: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Rank the rows; those that do not differ from the first of their group share its rank."""
        first = 0
        for place, row in enumerate(rows):
            leader = rows[first]["case"]
            cost, other = self._pairs(row["case"], leader, scenario)
            below = self.reference("optimum", scenario)
            below = other.mean(axis=0) if below is None else below
            alone = any(self._single(case, scenario) for case in (row["case"], leader))
            unpaired = alone or not len(cost)  # no training seed in common
            interval = None if unpaired else paired_difference(cost, other, below)[1]
            if interval is not None and interval[0] > 0:
                first = place
            row["rank"] = first + 1
        return rows

    def regrets(self, case: str, scenario: str) -> Array:
        """Regret (R,) of each run; infinite if J is not finite, NaN if J* is unknown."""
        runs = self.of(case, scenario)
        if self.reference("optimum", scenario) is None:
            return np.full(len(runs), np.nan)
        return np.where(np.isfinite(runs.J), runs.regret, np.inf)

    @cached_property
    def aggregate(self) -> pd.DataFrame:
        """Regret over all runs of cases that ran on all (several) scenarios with known J*.

        The bootstrap is stratified: runs are resampled within their scenario.
        """
        rows: list[dict[str, Any]] = []
        known = [s for s in self.scenarios if self.reference("optimum", s) is not None]
        for case in self.cases if len(known) > 1 else ():
            strata = [self.regrets(case, scenario) for scenario in known]
            if not all(map(len, strata)):
                continue
            spread, everything = over_runs(strata), np.concatenate(strata)
            row = {"case": case, "scenarios": len(strata), "runs": len(everything)}
            row |= {"regret_median": np.median(everything), "regret_worst": everything.max()}
            rows.append(row | _columns("regret_iqm", spread))
        rows.sort(key=lambda row: float(row["regret_iqm"]))
        return pd.DataFrame(rows, columns=AGGREGATE_COLUMNS)

    def to_pandas(self) -> pd.DataFrame:
        """A copy of `runs`, a row for each run."""
        return self.runs.copy()

    def lines(
        self, scenario: str, columns: Sequence[str] | None = None
    ) -> tuple[Sequence[str], list[list[str]]]:
        """Header and rows of a scenario's table as texts; `columns` are keys of `COLUMNS`.

        By default all, the last three only where a case has a counterpart. Raises StudyError for
        another column.
        """
        if columns is None:
            paired = any(case.get("against") for case in self.cases.values())
            columns = list(COLUMNS) if paired else list(COLUMNS)[:-3]
        for name in columns:
            if name not in COLUMNS:
                raise StudyError(f"a table has no column '{name}'{instead(name, COLUMNS)}")
        own = self.summary[self.summary.scenario == scenario].to_dict("records")
        return report.texts(own, dict(COLUMNS[name] for name in columns))

    def table(self, scenario: str | None = None) -> str:
        """A scenario's table as Markdown, lowest J first; None: the tables of all scenarios."""
        if scenario is not None:
            return markdown_table(*self.lines(scenario))
        return "\n".join(f"{name}\n\n{self.table(name)}" for name in self.scenarios)

    def _facts(self) -> dict[str, object]:
        counted = {"scenarios": self.scenarios, "cases": self.cases, "runs": self.state}
        counts = {name: len(each) for name, each in counted.items()}
        return {"name": self.name, **counts, "folder": self.folder}

    def _repr_html_(self) -> str:
        tables = {name: self.lines(name, SHORT) for name in self.scenarios}
        return "".join(
            f"<h4>{escape(name)}</h4>" + pd.DataFrame(rows, columns=list(head)).to_html(index=False)
            for name, (head, rows) in tables.items()
        )

    def further(self) -> Iterator[TextTable]:
        """Title, header and rows of the tables that the study asks for beside its summary."""
        against = {name: case.get("against") for name, case in self.cases.items()}
        for scenario, about in (self.about.get("operation") or {}).items():
            judged, seconds = self._judged(scenario), self._seconds(scenario)
            yield from operation.tables(judged, scenario, about, against, seconds)
        if "paper" in self.about["tables"]:
            yield self.paper()

    def paper(self) -> TextTable:
        """Title, header and rows: gains of each trained case's median run on every scenario.

        The paper's two gains imply J(b)/J(a) = (1 − 0.21)/(1 − 0.15) = 0.93.
        """
        rows = []
        trained = [name for name, case in self.cases.items() if case["trained"]]
        for scenario, case in product(self.scenarios, trained):
            bases = [self._arrays.get((scenario, name)) for name in PAPER]
            own = self._arrays.get((scenario, case))
            known = [base for base in bases if base is not None]
            if own is None or len(known) < len(bases):
                continue
            cost = own["J"].mean(axis=1)
            middle = np.argsort(cost, kind="stable")[(len(cost) - 1) // 2]
            gains = [
                statistics.gain(own[name][middle], base[name][0])
                for name in ("J", "economic_cost")
                for base in known
            ]
            agrees = [
                f"({letter})"
                for letter, found, wanted in zip("ab", gains[:2], PAPER.values(), strict=True)
                if abs(100 * found.value - wanted) <= NEAR
            ]
            ratio = f"{known[1]['J'].mean() / known[0]['J'].mean():.3f}"
            texts = (shown(*one, 100.0, 3) for one in gains)
            best = shown(float(cost[middle]), digits=6)
            rows.append([scenario, case, ratio, best, *texts, " and ".join(agrees)])
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
        names = [f"{kind}-{scenario}" for scenario in self.scenarios for kind in self._makers]
        name = name or f"regret-{self.scenarios[0]}"
        kind, _, scenario = name.partition("-")
        drawn = self._makers[kind](scenario) if name in names else None
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
        return {
            scenario: save_set(
                (
                    (f"{kind}-{safe(scenario)}", drawn)
                    for kind, maker in self._makers.items()
                    if (drawn := maker(scenario)) is not None
                ),
                folder,
                formats,
            )
            for scenario in self.scenarios
        }

    @property
    def _styles(self) -> dict[str, LineStyle]:
        return palette(list(self.cases), self.scenarios)

    def _regret(self, scenario: str) -> Figure | None:
        if self.reference("optimum", scenario) is None:
            return None
        rows = []
        for row in self.summary[self.summary.scenario == scenario].to_dict("records"):
            case = str(row["case"])
            if case != self.about["optimum"][scenario]:
                kind = "regret_iqm" if row["runs"] > 1 else "regret_median"
                middle, low, high = (100 * row[f"{kind}{end}"] for end in ("", "_low", "_high"))
                lost = self.of(case, scenario).status.str.startswith("diverged").to_numpy()
                values = 100 * self.regrets(case, scenario)
                rows.append(DotRow(case, values, ~lost, middle, low, high))
        return figures.regret_figure(rows, self._styles) if rows else None

    def _curves(self, scenario: str) -> Figure | None:
        """None if no training was evaluated more than once."""
        own = self.curves[self.curves.scenario == scenario]
        levels = own[own.training_seed.isna()].set_index("case").greedy_J
        trained = own[own.training_seed.notna()]
        greedy = trained.dropna(subset="greedy_J").groupby(KEYS).greedy_J
        drawn = trained[~trained.case.isin(self.baselines)].groupby("case", sort=False)
        if not (greedy.size() > 1).any() or not len(drawn):
            return None
        first, optimum = (self.about[kind].get(scenario) for kind in ("naive", "optimum"))
        best = float(levels.get(optimum, np.nan))
        known = bool(np.isfinite(best))
        curves = {
            str(case): figures.learning_curve(rows, best if known else None) for case, rows in drawn
        }
        marks = pd.concat([levels, greedy.last().groupby("case").median()])
        marks = marks[marks.index.isin(self.baselines) & (marks.index != optimum)]
        marks = marks[np.isfinite(marks)]
        # Naive stays: it is where the curves begin.
        chosen = sorted(marks.index, key=lambda name: (name != first, marks[name]))[:LEVELS]
        level = 100 * statistics.regrets(marks[chosen].to_numpy(), best) if known else marks[chosen]
        levels = dict(zip(chosen, map(float, level), strict=True))
        return figures.curves_figure(curves, levels, self._styles, relative=known)

    def _judged(self, scenario: str) -> operation.Judged:
        lives = read_table(self.folder / OPERATION, needed=["samples"])
        lives = lives.reindex(columns=MEASURED[OPERATION])  # an older table lacks the latest ones
        greedy = read_table(self.folder / GREEDY, MEASURED[GREEDY])
        own = [table[table.scenario == scenario] for table in (lives, greedy)]
        return operation.judged(own[0], own[1], self.about["optimum"].get(scenario, ""))

    def _seconds(self, scenario: str) -> dict[str, float]:
        """Median processor time in s of a case's runs, up to their last sample."""
        path = self.folder / TIMING
        if not path.is_file():
            return {}
        clock = read_table(path, needed=["run"]).set_index("run").training_seconds
        last = self.about["operation"][scenario]["columns"][-1]
        own = self.state[(self.state.scenario == scenario) & self.state.training_seed.notna()]
        names = own.case + " on " + scenario + ", seed " + own.training_seed.astype(str)
        seconds = (names + f", sample {last}").map(clock)
        return dict(seconds.groupby(own.case).median())

    def _operation(self, scenario: str) -> Figure | None:
        if scenario not in (self.about.get("operation") or {}):
            return None
        about, judged = self.about["operation"][scenario], self._judged(scenario)
        if judged.lives.samples.nunique() == 1:  # no course to draw
            return None
        return figures.operation_figure(judged, about, self._styles, self.baselines)

    def report(self) -> Path:
        """Write report.html, report.md and figures/ into the study's folder; returns the page."""
        page = self._page(self.draw(self.folder / report.FOLDER))

        def picture(name: str) -> dict[str, str] | None:
            path = self.folder / report.FOLDER / f"{name}.svg"
            # Those of a stored study's single runs are there once `cosim results draw` drew them.
            return report.image(path) if path.is_file() else None

        for name in (report.TABLES, report.PAGE):
            write_atomically(self.folder / name, report.rendered(name, **page, picture=picture))
        return self.folder / report.PAGE

    def _page(self, drawn: Mapping[str, list[str]]) -> dict[str, Any]:
        """The report, for its templates.

        A section has a title and may have a note, a table, and names of figures in `figures`.
        """
        sections: list[dict[str, Any]] = []
        for name in self.scenarios:
            words = {"title": f"Scenario {name}", "note": self._noise(name)}
            sections.append(words | {"table": self.lines(name), "figures": drawn[name]})
        if len(self.aggregate):
            table = report.texts(self.aggregate.to_dict("records"), report.AGGREGATE)
            sections.append({"title": "All scenarios", "table": table})
        sections += [{"title": title, "table": table} for title, *table in self.further()]
        if self.about["pictures"]:
            sections.append({"title": "Sample by sample", "figures": self.about["pictures"]})
        table = report.texts(self.cases.values(), report.CASES)
        sections.append({"title": "Cases", "table": table})
        made = self.about["made_with"]
        return {
            "title": self.about["title"] or self.name,
            "description": self.about["description"],
            "runs": len(self.state),
            "missing": self.about["runs"] - len(self.state),
            "sections": sections,
            "every": report.texts(self.runs.to_dict("records"), report.EVERY_RUN),
            "command": ["cosim", "study", "run", self.about.get("file") or f"{self.name}.toml"],
            "made": f"Made with {made['versions']}; code {made['code_hash']}"
            + (f"; commit {made['commit']}" if made.get("commit") else ""),
            "date": report.date(self.folder / TIMING),
        }

    def _noise(self, scenario: str) -> str:
        """The noise that a scenario's figures were measured on."""
        own = self.evaluation[self.evaluation.scenario == scenario]
        if own.empty:
            return "No run is finished."
        seeds, steps = self.about["curves"][scenario]
        return (
            f"Table and regret: {own.seed.nunique()} noise seeds × {own.steps.iloc[0]} "
            f"samples. Learning curves: {seeds} other seeds × {steps} samples. Regrets of a case "
            "differ between the two."
        )


def _columns(name: str, found: Estimate) -> dict[str, float]:
    low, high = found.interval or (np.nan, np.nan)
    return {name: found.value, f"{name}_low": low, f"{name}_high": high}


def _measured(stores: Iterable[RunStore]) -> dict[str, pd.DataFrame]:
    """The tables `MEASURED` of finished runs.

    In operation the optimum has a life on the noise of every training seed, of which J is known.
    """
    parts: dict[str, list[pd.DataFrame]] = {name: [] for name in MEASURED}
    for store in stores:
        run, about = store.run, store.about
        key = dict(zip(KEYS, (run.scenario.name, run.case, run.seed), strict=True))
        counts = {name: int(about.get(name, 0)) for name in ("samples", "plant_samples")}
        parts[RUNS].append(pd.DataFrame([key | {"status": store.status or "evaluated"} | counts]))
        if run.training is not None:
            log = read_table(store.folder / LOG).assign(**key)
            parts[CURVES].append(log)
            parts[OPERATION] += [log] if run.training.marks else []
        online = []
        for file, noise in run.noise.items():
            if noise.whole:
                continue
            rows = store.measured(file).rename_axis("seed").reset_index()
            if (mark := run.marks.get(file)) is not None:
                parts[GREEDY].append(rows.assign(**key, samples=mark))
            elif file == GREEDY:
                mean = key | {"greedy_J": float(rows.J.mean())}
                parts[CURVES].append(pd.DataFrame([mean]))
            elif file == EVALUATION:
                parts[EVALUATION].append(rows.assign(**key, steps=noise.steps))
            else:
                life = key | {"training_seed": rows.seed, "samples": noise.steps}
                online.append(rows[["J"]].assign(**life))
        if online:
            parts[OPERATION].append(pd.concat(online).sort_values(["training_seed", "samples"]))
    none = [pd.DataFrame()]
    found = {name: pd.concat(own or none, ignore_index=True) for name, own in parts.items()}
    return {name: typed(found[name].reindex(columns=columns)) for name, columns in MEASURED.items()}


def _timing(stores: Iterable[RunStore]) -> pd.DataFrame:
    """Seconds that each run's training took; in operation the processor's up to each mark, too."""
    rows = []
    for store in stores:
        clock = store.about.get("timing", {})
        seconds = {str(store.run): clock.get("wall_seconds", 0.0)}
        marks = clock.get("processor_seconds", {})
        seconds |= {f"{store.run}, sample {mark}": value for mark, value in marks.items()}
        rows += [{"run": name, "training_seconds": float(value)} for name, value in seconds.items()]
    return pd.DataFrame(rows, columns=["run", "training_seconds"])


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
                **{name: getattr(case, name) for name in SAME},
                "trained": case.algorithm is not None,
                "against": definition.counterpart(case),
            }
            for case in definition.all_cases
        ],
        "file": Path(definition.file).name if definition.file else None,
        "optimum": definition.optima,
        "naive": dict.fromkeys(scenarios, definition.named(NAIVE)),
        "curves": {name: [len(noise.seeds), noise.steps] for name, noise in curves.items()},
        "runs": len(plan.runs),
        "tables": list(definition.table.tables),
        "made_with": dict(plan.provenance) | {"commit": report.commit()},
    }
    trains = any(case.algorithm for case in definition.cases)
    if (table := definition.table.operation) is not None and trains:
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
    return dict(json.loads(json.dumps(about)))


def study(
    source: Study | str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Progress | bool = False,
    planned: Plan | None = None,
    figures: bool = True,
) -> StudyResults:
    """Do the runs of a study that `out` lacks, and write its tables there.

    Raises StudyError and what scenarios and algorithms raise before any work is done;
    FailedRunsError after all other runs are done and written.

    Args:
        source: a study, its file, or the same document as a mapping.
        jobs: worker processes; 1 works in this process. No byte of a table depends on it.
        scheduler: address of a Dask scheduler, used in place of `jobs`.
        progress: a `Progress`, called after every work item, and with a line for each run that
            ends; True draws a bar.
        planned: the study's plan, if it is known.
        figures: whether the study's trajectories and logs are drawn.
    """
    if isinstance(source, Mapping):
        source = Study.from_dict(source)
    definition, folder = source if isinstance(source, Study) else Study.load(source), Path(out)
    planned = planned or plan(definition)
    with holding(folder), reporting(progress, definition.name, planned.samples) as report:
        runner = Runner(planned.runs, folder, report)
        for line in runner.remarks:
            report(0, "", line)
        runner.run(jobs, scheduler)
        stores = runner.stores.values()
        results = StudyResults.written(planned, folder, stores, draw=figures)
    if runner.failures:
        name, failure = next(iter(runner.failures.items()))
        others = f" ({more} more failed)" if (more := len(runner.failures) - 1) else ""
        raise FailedRunsError(f"{name}: {failure.message}{others}; run again to try anew")
    return results
