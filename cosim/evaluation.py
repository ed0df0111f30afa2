"""`evaluate`: controllers × seeds on common random numbers; `judge`: loops of other tools."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from controllers.factories import (
    ControllerSource,
    build_controller,
    parameters_hash,
    stored_optimum,
)
from cosim.core import statistics
from cosim.core.errors import EvaluationError
from cosim.core.files import holding, staged
from cosim.core.protocols import Array, Decision
from cosim.core.result import Result, text_table
from cosim.core.run_files import EVALUATION_FILES
from cosim.core.scenario import Scenario
from cosim.core.simulation import indicators, measure, reporting, simulate
from cosim.core.training_options import PARAMETERS
from cosim.core.validation import instead, whole_number
from cosim.measurement import Factory, Measured, MeasureItem, Noise, built
from cosim.plant import FmuPlant
from cosim.workers import Conditions, Failure, cores, done

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAIVE = "naive"
OPTIMAL = "optimal"
EVALUATION = "evaluation.csv"
TIMING = "timing.csv"
PICTURE = "evaluation.png"
MOST_SEEDS = 1_000_000
WORKER_START = 2.0
"""Seconds of work below which starting workers takes longer than doing it."""
ITEM_SECONDS = 0.5
"""Seconds of an item of work of our own code, about: each moves the bar."""
ITEM_SAMPLES = 50
"""Samples of an item of others' code, about: few, since each step of a plant may take a second."""
Progress = Callable[[int, str, str], None]
"""Called with the plant samples done, what is done in words, and a line about an event, or ""."""

MEANS = ("economic_cost", "mean_violation", "violating_share", "J", "input_effort")
COMPARED = ("J", "economic_cost", "mean_violation", "violating_share")
TABLE_TITLES = {
    "controller": "controller",
    "regret": "regret %",
    "J": "J",
    "economic_cost": "economic cost",
    "violating": "violating %",
    "failures": "failures",
    "mean_violation": "mean violation",
    "input_effort": "input effort",
}
"""Titles of the columns of a printed table, by the names that `Evaluation.table` takes."""
TABLE_COLUMNS = ("controller", "regret", "J", "economic_cost", "violating", "failures")
EVALUATION_COLUMNS = [
    "controller", "scenario", "seed", "steps", "economic_cost", "mean_violation",
    "violating_share", "J", "regret", "gap_closed", "gain_in_J", "input_effort", "failures",
    "version", "versions", "code_hash", "scenario_hash", "fmu_sha256", "parameters_hash",
    "command",
]  # fmt: skip


def evaluate(
    scenario: Scenario | str | Path,
    controllers: Mapping[str, Factory | str] | Sequence[str],
    seeds: int | Sequence[int],
    steps: int,
    *,
    folder: str | Path | None = None,
    jobs: int | None = 1,
    scheduler: str | None = None,
    progress: Progress | bool = False,
    command: str = "cosim.evaluate",
) -> Evaluation:
    """Run every controller on every seed; the table is the same for any number of workers.

    On a seed all controllers meet the same disturbances (common random numbers). A stored optimum
    runs too, for J*, without rows of its own unless it is named. Every run is computed again.

    Args:
        scenario: a scenario, a preset's name or a TOML file.
        controllers: by name a factory(scenario) -> Controller, importable where the workers run, or
            what `cosim.build_controller` takes; or only such texts, or `NAME=…`. The one named
            `naive`, else the first, is the gains' reference; `optimal` gives J*.
        seeds: the seeds, or their number S for 0 … S−1.
        steps: samples per run, from the scenario's initial state on.
        folder: where the tables are written at the end (`Evaluation.write`); None writes none.
        jobs: worker processes at most; 1 works in this process, None has one per core. Work of our
            own code that takes less time than their start is done in this process.
        scheduler: address of a Dask scheduler, used in place of `jobs`.
        progress: called as `cosim.study` does; True draws a bar.
        command: the text of the column `command`.

    Returns:
        Indicators by controller and seed.

    Raises:
        EvaluationError: the request is malformed, the workers failed, or one of them found other
            files than were there when the work was given out.
        CosimError: another process writes to the folder; and what building or running a
            controller raises.
    """
    if not isinstance(scenario, Scenario):
        scenario = Scenario.load(scenario)
    seed_numbers = _distinct_seeds(seeds)
    steps = whole_number("steps", steps, 1, EvaluationError)
    named = named_controllers(controllers)
    _check_names(named)
    wanted = list(named)
    if OPTIMAL not in named:
        optimum = stored_optimum(scenario)
        if optimum is not None:
            named[OPTIMAL] = optimum
    noise = Noise(seed_numbers, steps)
    # Hold the folder before the work, which may take hours.
    with holding(Path(folder)) if folder is not None else nullcontext():
        evaluation = _measure_all(
            scenario, named, wanted, noise, jobs, scheduler, progress, command
        )
        if folder is not None:
            evaluation.write(folder)
    return evaluation


def _measure_all(
    scenario: Scenario,
    named: Mapping[str, Factory | str],
    wanted: Sequence[str],
    noise: Noise,
    jobs: int | None,
    scheduler: str | None,
    progress: Progress | bool,
    command: str,
) -> Evaluation:
    """Measure each of the controllers on the noise; the `wanted` have rows of their own."""
    runs: dict[str, MeasureItem] = {}
    seconds = {}
    parameters = {}
    for name, description in named.items():
        source = ControllerSource.read(description) if isinstance(description, str) else description
        conditions = Conditions.of_now(scenario, description)
        run = MeasureItem(conditions, source, noise, noise.length)
        runs[name] = run
        # Built here once, so that a fault shows before any worker starts.
        controller = built(source, conditions.scenario)
        parameters[name] = parameters_hash(controller)
        # A factory is code of others, whatever its module.
        if conditions.all_ours and isinstance(description, str):
            seconds[name] = run.seconds_a_run()
    # The columns are of what all have: versions, our code, scenario and FMU.
    facts = conditions.facts
    all_timed = len(seconds) == len(runs)
    total_seconds = len(noise.seeds) * sum(seconds.values())
    if all_timed and total_seconds < WORKER_START:
        jobs = 1
    elif jobs is None:
        jobs = cores()
    items = _split(runs, seconds)
    measured = {name: Measured() for name in named}
    n_done = 0
    total = len(named) * noise.samples
    with reporting(progress, scenario.name, total) as report:

        def show(samples_at_work: int) -> None:
            n_samples = n_done + samples_at_work
            report(n_samples, f"{n_samples / total:.0%}", "")

        for key, result in done(items, jobs, scheduler, show):
            # A mean over fewer seeds would be another figure under the same name.
            if isinstance(result, Failure):
                raise result.error()
            name, _ = key
            measured[name].indicators.update(result.indicators)
            measured[name].timing.update(result.timing)
            n_done += items[key].noise.samples
            show(0)
    columns = {}
    timing = {}
    for name, measurement in measured.items():
        columns[name] = _frame(measurement.indicators, noise.seeds)
        timing[name] = _frame(measurement.timing, noise.seeds)
    return Evaluation(
        scenario=scenario,
        controllers=wanted,
        seeds=noise.seeds,
        columns=columns,
        timing=timing,
        parameters=parameters,
        facts={
            "scenario": scenario.name,
            "steps": noise.steps,
            "version": version("rti-cosim"),
            "versions": facts["versions"],
            "code_hash": facts["rti-cosim"],
            "scenario_hash": facts["scenario"],
            "fmu_sha256": facts["fmu"],
            "command": command,
        },
    )


def _split(
    runs: Mapping[str, MeasureItem],
    seconds: Mapping[str, float],
) -> dict[tuple[str, int], MeasureItem]:
    """Items of work of a few seeds each, by the controller's name and the first seed.

    Args:
        runs: each controller on all seeds, by its name.
        seconds: time of a run on one seed, where it is known.
    """
    items = {}
    for name, run in runs.items():
        noise = run.noise
        if name in seconds:
            size = int(ITEM_SECONDS / seconds[name]) + 1
        else:
            # Code of others may remember one run in the next, and may end its process: its items
            # are always the same, and it is not run here to be timed.
            size = max(1, ITEM_SAMPLES // noise.length)
        n_seeds = min(len(noise.seeds), size)
        for part in run.parts(n_seeds):
            first_seed = part.noise.seeds[0]
            items[name, first_seed] = part
    return items


def _frame(rows: Mapping[int, Mapping[str, float]], seeds: Sequence[int]) -> pd.DataFrame:
    """Rows by seed as a frame, in the order of the seeds."""
    frame = pd.DataFrame.from_dict(rows, "index")
    # Items end in any order.
    return frame.reindex(list(seeds))


def named_controllers(
    controllers: Mapping[str, Factory | str] | Sequence[str],
) -> dict[str, Factory | str]:
    """Controllers by name.

    Args:
        controllers: a mapping, or texts CONTROLLER or NAME=CONTROLLER.

    Raises:
        EvaluationError: one is neither a text nor a factory, or two have one name.
    """
    if isinstance(controllers, Mapping):
        for name, controller in controllers.items():
            is_one = isinstance(controller, str) or callable(controller)
            if not isinstance(name, str) or not is_one:
                raise EvaluationError(
                    f"controllers: '{name}' must be a name or a factory(scenario), not "
                    f"a {type(controller).__name__}"
                )
        return dict(controllers)
    # A text is a sequence as well, of its letters.
    if isinstance(controllers, str) or not isinstance(controllers, Sequence):
        raise EvaluationError("controllers must be a list of names, or a mapping")
    named: dict[str, Factory | str] = {}
    for item in controllers:
        if not isinstance(item, str):
            raise EvaluationError(f"controllers: a {type(item).__name__} is no name")
        before, equals, after = item.partition("=")
        name = before.strip()
        source = after.strip() if equals else name
        if name.endswith(".toml"):
            name = _name_of_file(name)
        if not name or not source:
            raise EvaluationError(f"controllers: '{item}' is not NAME=CONTROLLER")
        if name in named:
            raise EvaluationError(f"two controllers are called '{name}'; write NAME=… for one")
        named[name] = source
    return named


def _name_of_file(path: str) -> str:
    """Name of a file of θ: its folder where a training named the file, else its stem."""
    file = Path(path)
    folder = file.parent.name
    # All trainings call it the same.
    if file.name == PARAMETERS and folder not in ("", ".."):
        return folder
    return file.stem


def _distinct_seeds(seeds: int | Sequence[int]) -> tuple[int, ...]:
    """Seeds as integers; raises EvaluationError where they are none, or one is there twice."""
    numbers = _seed_numbers(seeds)
    if not numbers:
        raise EvaluationError("no seed to evaluate on; give at least one")
    # A seed twice would count twice, and make an interval narrower than it is.
    if len(set(numbers)) < len(numbers):
        raise EvaluationError("seeds must be distinct")
    greatest = max(numbers)
    if greatest >= 1 << 64:
        raise EvaluationError(f"seeds must be below 2⁶⁴; the last one is {greatest}")
    return numbers


def _seed_numbers(seeds: int | Sequence[int]) -> tuple[int, ...]:
    """The seeds in their order, those below S for a number S."""
    # Texts and mappings can be iterated over, but are no lists of seeds; an array without
    # dimensions is a number.
    is_text_or_table = isinstance(seeds, str | bytes | Mapping)
    is_number = getattr(seeds, "ndim", 1) == 0
    if isinstance(seeds, Iterable) and not is_text_or_table and not is_number:
        numbers = []
        for seed in seeds:
            number = whole_number("a seed", seed, 0, EvaluationError)
            numbers.append(number)
        return tuple(numbers)
    count = whole_number("seeds", seeds, 1, EvaluationError)
    if count > MOST_SEEDS:
        raise EvaluationError(f"seeds must be at most {MOST_SEEDS}, not {count}")
    return tuple(range(count))


def _check_names(controllers: Mapping[str, Factory | str]) -> None:
    """Refuse no controller, and another one by the name of the optimum."""
    if not controllers:
        raise EvaluationError("no controller to evaluate")
    optimal = controllers.get(OPTIMAL, OPTIMAL)
    if isinstance(optimal, str) and optimal != OPTIMAL:
        raise EvaluationError(f"'{OPTIMAL}' names the controller that gives J*, not '{optimal}'")


SAME_RUNS_NOTE = "no noise: all seeds are the same run, and an interval of width 0 says nothing"


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Result):
    """Indicators of controllers × seeds on common random numbers.

    Attributes:
        scenario: on which they were measured.
        controllers: names of those that have rows, as given.
        seeds: of the noise, S of them.
        columns, timing: measurements by controller, a frame with a row for each seed.
        parameters: hash of each controller's parameters.
        facts: the table's columns that do not vary.
    """

    scenario: Scenario
    controllers: Sequence[str]
    seeds: Sequence[int]
    columns: Mapping[str, pd.DataFrame]
    timing: Mapping[str, pd.DataFrame]
    parameters: Mapping[str, str]
    facts: Mapping[str, Any]

    def _facts(self) -> dict[str, object]:
        facts: dict[str, object] = {
            "scenario": self.facts["scenario"],
            "steps": self.facts["steps"],
            "seeds": len(self.seeds),
        }
        for name in self.controllers:
            cost = self.column(name, "J")
            facts[f"J of {name}"] = float(cost.mean())
        if self.optimum is not None:
            facts["J*"] = float(self.optimal.mean())
        return facts

    @property
    def optimum(self) -> str | None:
        """Name of the controller that gives J*, or None."""
        return OPTIMAL if OPTIMAL in self.columns else None

    @property
    def reference(self) -> str:
        """Name of the controller that gains are measured against."""
        return NAIVE if NAIVE in self.controllers else self.controllers[0]

    @property
    def optimal(self) -> Array:
        """J of the optimum over the seeds, (S,), NaN where it is not known."""
        return self._cost(OPTIMAL)

    def column(self, controller: str, name: str) -> Array:
        """An indicator of a controller over the seeds, (S,).

        Args:
            controller: its name.
            name: the indicator's.

        Raises:
            EvaluationError: there is no such controller or indicator.
        """
        if controller not in self.columns:
            raise EvaluationError(f"there is no '{controller}'{instead(controller, self.columns)}")
        frame = self.columns[controller]
        if name not in frame:
            # Iteration over a frame gives its titles.
            titles = [str(title) for title in frame]
            raise EvaluationError(f"there is no '{name}'{instead(name, titles)}")
        return np.asarray(frame[name])

    @property
    def without_noise(self) -> bool:
        """Whether all seeds, of which there are several, gave each controller the same run."""
        if len(self.seeds) == 1:
            return False
        for name in self.controllers:
            cost = self.column(name, "J")
            if (cost != cost[0]).any():
                return False
        return True

    def _cost(self, controller: str) -> Array:
        """J over the seeds, (S,), NaN of a controller that was not evaluated."""
        if controller not in self.columns:
            return np.full(len(self.seeds), np.nan)
        return self.column(controller, "J")

    def to_pandas(self) -> pd.DataFrame:
        """A row for each controller, as given, and seed; NaN where an indicator is undefined."""
        frame = self._rows(self.columns)
        frame = frame.assign(**self.facts)
        frame["parameters_hash"] = frame.controller.map(self.parameters)
        cost = frame.J.to_numpy()
        optimal = self._cost_for_rows(OPTIMAL)
        naive = self._cost_for_rows(NAIVE)
        reference = self._cost_for_rows(self.reference)
        frame["regret"] = statistics.regrets(cost, optimal)
        frame["gap_closed"] = statistics.gaps_closed(cost, naive, optimal)
        frame["gain_in_J"] = statistics.gains(cost, reference)
        table = frame[EVALUATION_COLUMNS]
        # A count, which stands among real numbers in a run's figures.
        return table.astype({"failures": int})

    def _cost_for_rows(self, controller: str) -> Array:
        """J of a controller on the seed of each row of the table."""
        # The rows of all controllers are on the same seeds, one controller after the other.
        return np.tile(self._cost(controller), len(self.controllers))

    def _rows(self, frames: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
        """Frames of the controllers one below the other, with controller and seed as columns."""
        # The optimum's frame may be there without being asked for.
        asked_for = {name: frames[name] for name in self.controllers}
        rows = pd.concat(asked_for)
        named = rows.rename_axis(["controller", "seed"])
        return named.reset_index()

    def to_csv(self) -> str:
        """The table as CSV; floats read back to the same bits, undefined ones are empty."""
        table = self.to_pandas()
        return str(table.to_csv(index=False, lineterminator="\n"))

    def figure(self, width: float | None = None) -> Figure:
        """Regret (J where J* is not known) and the share of violating samples, with intervals.

        Args:
            width: in inches; by default that of two columns of a journal.
        """
        from cosim.figures.evaluation import evaluation_figure  # noqa: PLC0415 - matplotlib
        from cosim.figures.style import WIDTH  # noqa: PLC0415

        columns = {name: self.columns[name] for name in self.controllers}
        scenario = self.facts["scenario"]
        runs = f"{self.facts['steps']} samples × {len(self.seeds)} seeds"
        return evaluation_figure(
            columns,
            title=f"{scenario}, {runs}, the same disturbances for all",
            optimal=None if self.optimum is None else self.optimal,
            width=width or WIDTH,
        )

    def table(
        self,
        columns: Sequence[str] = TABLE_COLUMNS,
        *,
        format: str = "markdown",
    ) -> str:
        """A row for each controller, its means over the seeds.

        Args:
            columns: keys of `TABLE_TITLES`.
            format: markdown, latex or html.

        Raises:
            EvaluationError: there is no such column.
            CosimError: there is no such format.
        """
        for column in columns:
            if column not in TABLE_TITLES:
                raise EvaluationError(
                    f"a table has no column '{column}'{instead(column, TABLE_TITLES)}"
                )
        rows = []
        for name in self.controllers:
            cells = self._cells(name)
            rows.append([cells[column] for column in columns])
        header = [TABLE_TITLES[column] for column in columns]
        return text_table(header, rows, format)

    def __str__(self) -> str:
        return self.table()

    def _cells(self, name: str) -> dict[str, str]:
        """Texts of a controller's row, by the keys of `TABLE_TITLES`."""
        cells = {
            "controller": name,
            "regret": "",
            "J": statistics.shown(float(self.column(name, "J").mean()), digits=6),
            "failures": str(int(self.column(name, "failures").sum())),
        }
        for column, places in (("economic_cost", 2), ("mean_violation", 5), ("input_effort", 5)):
            cells[column] = f"{self.column(name, column).mean():.{places}f}"
        cells["violating"] = f"{100 * self.column(name, 'violating_share').mean():.2f}"
        if self.optimum is None:
            return cells
        cost = self._cost(name)
        estimate = statistics.regret(cost, self.optimal)
        size = statistics.magnitude(self.optimal)
        # The cost of rare violations is skewed, which Student's interval does not know.
        interval = statistics.bootstrapped(cost - self.optimal, size) or estimate.interval
        cells["regret"] = statistics.shown_estimate(estimate.value, interval, 100.0)
        return cells

    def write(self, folder: str | Path) -> None:
        """Write evaluation.csv, evaluation.png, timing.csv and scenario.toml, all or none."""
        with staged(folder, EVALUATION_FILES) as stage:
            self.write_files(stage)

    def write_files(self, folder: Path) -> None:
        """Write the files of `write` one after the other."""
        self.plot(folder / PICTURE)
        self.write_tables(folder)

    def write_tables(self, folder: Path) -> None:
        """Write the files of `write` but the picture, which takes a second."""
        (folder / "scenario.toml").write_text(self.scenario.to_toml(), "utf-8")
        # Times of a clock have no more digits that mean anything.
        timing = self._rows(self.timing).round(3)
        tables = {EVALUATION: self.to_pandas(), TIMING: timing}
        for name, table in tables.items():
            # Write row by row: the text of all takes ten times the memory of the numbers.
            table.to_csv(folder / name, index=False, lineterminator="\n")

    def summary(self) -> dict[str, Any]:
        """The evaluation as a JSON document: controllers, comparisons, provenance, timing.

        `controllers`: per controller the means over all seeds and samples, the `intervals` of each
        mean, and `failures` in total. Where J* is known there is the `regret` (J − J*)/|J*|, and
        with the naive controller `gap_closed` = (J_naive − J)/(J_naive − J*). `comparisons`: for
        each pair, the paired difference controller − reference of each mean, and `gain_in_J`,
        (J_ref − J)/|J_ref|. Every interval is of 95 %, paired over seeds, `interval` Student's and
        `bootstrap` BCa. `optimal_J` is J* on the same seeds.
        """
        comparisons = []
        for number, name in enumerate(self.controllers):
            for reference in self.controllers[:number]:
                comparisons.append(self._comparison(name, reference))
        document: dict[str, Any] = dict(self.facts)
        document["seeds"] = list(self.seeds)
        if self.without_noise:
            document["remark"] = SAME_RUNS_NOTE
        document["reference"] = self.reference
        document["optimum"] = self.optimum
        document["optimal_J"] = None
        if self.optimum is not None:
            document["optimal_J"] = float(np.mean(self.optimal))
        controllers = {}
        # Medians over the seeds: one run that the machine held up does not count.
        medians = {}
        for name in self.controllers:
            controllers[name] = self._controller(name)
            medians[name] = self.timing[name].median().to_dict()
        document["controllers"] = controllers
        document["comparisons"] = comparisons
        document["timing"] = medians
        return document

    def _controller(self, name: str) -> dict[str, Any]:
        """A controller's part of the summary."""
        document: dict[str, Any] = {}
        intervals = {}
        for indicator in MEANS:
            values = self.column(name, indicator)
            estimate = statistics.mean(values)
            document[indicator] = estimate.value
            intervals[indicator] = {"interval": estimate.interval}
        failures = self.column(name, "failures")
        document["failures"] = int(np.sum(failures))
        document["parameters_hash"] = self.parameters[name]
        document["intervals"] = intervals
        if self.optimum is None:
            return document
        cost = self._cost(name)
        optimal = self.optimal
        regret = statistics.regret(cost, optimal)
        size = statistics.magnitude(optimal)
        document["regret"] = {
            **regret._asdict(),
            "bootstrap": statistics.bootstrapped(cost - optimal, size),
        }
        if NAIVE in self.controllers:
            naive = self._cost(NAIVE)
            gap_closed = statistics.gap_closed(cost, naive, optimal)
            document["gap_closed"] = gap_closed._asdict()
        return document

    def _comparison(self, name: str, reference: str) -> dict[str, Any]:
        """Paired differences of two controllers, for the summary."""
        differences = {}
        for indicator in COMPARED:
            values = self.column(name, indicator)
            others = self.column(reference, indicator)
            # Seed by seed: the noise that both met cancels.
            estimate = statistics.mean(values - others)
            differences[indicator] = estimate._asdict()
        cost = self._cost(name)
        other = self._cost(reference)
        gain = statistics.gain(cost, other)
        size = statistics.magnitude(other)
        return {
            "controller": name,
            "reference": reference,
            "differences": differences,
            "gain_in_J": {
                **gain._asdict(),
                "bootstrap": statistics.bootstrapped(other - cost, size),
            },
        }


TOLERANCE = 1e-6
"""Largest difference of a state from the one played back, relative to 1 + its magnitude."""


class _Recorded:
    """Plays recorded actions back and holds the recorded states to the plant's."""

    name = "recorded"

    def __init__(
        self,
        path: Path,
        states: pd.DataFrame,
        actions: Array,
    ) -> None:
        self._path = path
        self._states = states
        self._actions = actions
        self._k = -1

    def reset(self) -> None:
        self._k = -1

    def prepare(self) -> None:
        self._k += 1

    def feedback(self, s: Array, a: object = None) -> Decision:
        """The sample's action; raises EvaluationError if the state belongs to other noise."""
        pairs = zip(self._states.items(), s.tolist(), strict=True)
        for (name, column), expected in pairs:
            recorded = float(column.iloc[self._k])
            allowed = TOLERANCE * (1 + abs(expected))
            # Written so that no number is refused, too.
            if not abs(recorded - expected) <= allowed:
                raise EvaluationError(
                    f"'{self._path}': {name} at sample {self._k} is {recorded!r}; the seed's noise "
                    f"under these actions gives {expected!r} (cosim scenario NAME --seed-values K "
                    "prints the plant's start values)"
                )
        return Decision(self._actions[self._k])


def judge(scenario: Scenario, folder: Path) -> pd.DataFrame:
    """Indicators of runs that another tool made, each played back on its seed's noise.

    A file has a column for each state and action of the scenario by name (a unit in brackets may
    follow) and a row a sample: the state, and the action then applied. The actions are played back
    on the seed's noise, and the file's states are checked against it; the figures are those of the
    playback.

    Args:
        scenario: what the runs are of.
        folder: holds a ``*.csv`` for each run, whose name ends in the run's seed.

    Returns:
        A row for each run: `file`, `scenario` and its hash, `seed`, `steps`, `indicators`', and
        `optimum` and `regret`, J of the stored optimum on the same noise, NaN without one.

    Raises:
        EvaluationError: a file is no trajectory or of other noise, with file, sample and both
            values; two files are of one seed or hold one run; or runs differ in length.
    """
    paths = sorted(folder.glob("*.csv"))
    if not paths:
        raise EvaluationError(f"'{folder}' holds no .csv file")
    runs = {path: _read_trajectory(path, scenario) for path in paths}
    _check_seeds_and_lengths(runs)
    optimum_name = stored_optimum(scenario)
    optimum = None if optimum_name is None else build_controller(optimum_name, scenario)
    # Runs that were played back, by what the plant did.
    played: dict[bytes, Path] = {}
    plant_table = scenario.plant
    names = (
        *plant_table.states,
        *plant_table.actions,
        *plant_table.disturbances,
        "stage_cost",
    )
    rows = []
    with FmuPlant(scenario) as plant:
        for path, (seed, recorded, steps) in runs.items():
            run = simulate(plant, recorded, steps, seed, residuals=False)
            # One run under two seeds would count twice.
            content = b"".join(run[name].tobytes() for name in names)
            other = played.setdefault(content, path)
            if other != path:
                raise EvaluationError(f"'{path}' holds the same run as '{other}': give it once")
            cost = np.nan
            if optimum is not None:
                of_optimum, _ = measure(plant, optimum, seed, steps)
                cost = of_optimum["J"]
            rows.append(
                {
                    "file": path.name,
                    "scenario": scenario.name,
                    "scenario_hash": scenario.hash,
                    "seed": seed,
                    "steps": steps,
                    **indicators(run),
                    "optimum": cost,
                }
            )
    table = pd.DataFrame(rows).sort_values("seed", ignore_index=True)
    costs = table.J.to_numpy()
    optima = table.optimum.to_numpy()
    table["regret"] = statistics.regrets(costs, optima)
    return table


def _check_seeds_and_lengths(runs: Mapping[Path, tuple[int, _Recorded, int]]) -> None:
    """Refuse runs whose mean would count a seed twice or short runs like long ones."""
    seeds: dict[int, Path] = {}
    first = next(iter(runs))
    _, _, first_steps = runs[first]
    for path, (seed, _, steps) in runs.items():
        other = seeds.setdefault(seed, path)
        if other != path:
            raise EvaluationError(f"'{path}' and '{other}' are both of seed {seed}: give one")
        if steps != first_steps:
            raise EvaluationError(
                f"'{path}' has {steps} samples, '{first}' {first_steps}: runs that are "
                "averaged must have the same length; cut them, or evaluate two folders"
            )


def _read_trajectory(path: Path, scenario: Scenario) -> tuple[int, _Recorded, int]:
    """Seed, player and number of samples of a file."""
    seed = _seed_of_file(path)
    plant = scenario.plant
    try:
        with warnings.catch_warnings():
            # Rows of unlike length, which pandas would fill up.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(path, index_col=False)
        # Titles may have units: `X2 [%]`.
        table = table.rename(columns=lambda title: title.partition(" [")[0].strip())
        names = [*plant.states, *plant.actions]
        numbers = table[names].astype(float)
        # Pandas gives all columns of a name.
        if numbers.shape[1] != len(names):
            raise ValueError("two columns have one name")
    except (OSError, ValueError, KeyError, TypeError, OverflowError, Warning) as error:
        reason = " ".join(str(error).split())
        raise EvaluationError(f"'{path}' is no trajectory: {reason}") from None
    # A simulation would clip them, and judge another run than the file's.
    actions = numbers[list(plant.actions)].to_numpy()
    steps = len(actions)
    above = actions >= scenario.action_lower
    below = actions <= scenario.action_upper
    # A missing one is no number, and so neither.
    inside = (above & below).all(axis=1)
    if steps == 0 or not inside.all():
        # The first that is not; a file without rows lacks that of sample 0.
        k = int(np.argmin(inside)) if steps else 0
        raise EvaluationError(f"'{path}': the action at sample {k} is missing or beyond its bounds")
    states = numbers[list(plant.states)]
    player = _Recorded(path, states, actions)
    return seed, player, steps


def _seed_of_file(path: Path) -> int:
    """The number at the end of a file's name."""
    number = re.search(r"(\d+)$", path.stem)
    if number is None:
        raise EvaluationError(f"'{path}': a file's name ends in its seed, as run-7.csv")
    seed = int(number[1])
    if seed >= 1 << 64:
        raise EvaluationError(f"'{path}': its seed must be below 2⁶⁴")
    return seed
