"""`evaluate`: controllers × seeds on common random numbers; `judge`: loops of other tools."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from controllers.optimum import stored_optimum
from cosim import statistics
from cosim.errors import EvaluationError
from cosim.files import replacing, temporary_folder
from cosim.plant import FmuPlant
from cosim.plugins import build_controller, code_hash, depends_on, parameters_hash, versions
from cosim.protocols import Array, Controller, Decision
from cosim.result import Result, markdown_table
from cosim.scenario import Scenario
from cosim.simulation import indicators, measure, reporting, simulate
from cosim.studies.run import EVALUATION, TIMING, Noise, Report, Run, Runner, to_csv
from cosim.validation import instead

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAIVE, OPTIMAL = "naive", "optimal"
Factory = Callable[[Scenario], Controller]

MEANS = ("economic_cost", "mean_violation", "violating_share", "J", "input_effort")
COMPARED = ("J", "economic_cost", "mean_violation", "violating_share")
COLUMNS = [
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
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Report | bool = False,
    command: str = "cosim.evaluate",
) -> Evaluation:
    """Run every controller on every seed; the table is the same for any number of workers.

    On a seed all controllers meet the same disturbances (common random numbers). A stored optimum
    runs too, for J*, without rows of its own unless it is named. Raises EvaluationError on a
    malformed request or failed workers, StudyError on a name that no folder can have, and what
    building or running a controller raises.

    Args:
        controllers: by name a factory(scenario) -> Controller, importable where the workers run, or
            what `cosim.plugins.build_controller` takes; or only such texts, or `NAME=…`. The
            one named `naive`, else the first, is the gains' reference; `optimal` gives J*.
        seeds: the seeds, or their number S for 0 … S−1.
        steps: samples per run, from the scenario's initial state on.
        folder: where finished runs are kept and found again; None keeps none.
        jobs: worker processes; 1 works in this process.
        scheduler: address of a Dask scheduler, used in place of `jobs`.
        progress: called as `cosim.study` does, with a line on what is done anew; True draws a bar.
        command: the text of the column `command`.
    """
    scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
    numbers = tuple(range(seeds)) if isinstance(seeds, int) else tuple(seeds)
    named = named_controllers(controllers)
    _check(named, numbers, steps)
    wanted = list(named)
    if OPTIMAL not in named and (optimum := stored_optimum(scenario)) is not None:
        named[OPTIMAL] = optimum
    with FmuPlant(scenario) as plant:
        fmu = plant.fmu_sha256
    facts = {
        "scenario": scenario.name,
        "steps": steps,
        "version": versions().partition("rti-cosim ")[2].partition(";")[0],
        "versions": versions(),
        "code_hash": code_hash(),
        "scenario_hash": scenario.hash,
        "fmu_sha256": fmu,
        "command": command,
    }
    noise = {EVALUATION: Noise(numbers, steps)}
    runs, parameters = [], {}
    for name, item in named.items():
        controller = build_controller(item, scenario) if isinstance(item, str) else item(scenario)
        parameters[name] = parameters_hash(controller)
        depends = depends_on(scenario, item, type(controller)) | {
            "fmu": fmu,
            "controller": item if isinstance(item, str) else _qualified(item),
            "parameters": parameters[name],
        }
        runs.append(Run(scenario, name, depends, noise, item))
    total = sum(run.samples for run in runs)
    bar = reporting(progress, scenario.name, total)
    with temporary_folder("cosim-evaluation-") as own, bar as tell:
        runner = Runner(runs, Path(folder or own), (Path.cwd(),), lambda *at: tell(*at[:2], ""))
        for line in runner.remarks:
            tell(0, "", line)
        runner.run(jobs, scheduler)
        for failure in runner.failures.values():
            raise failure.error()
        stores = dict(zip(named, runner.stores.values(), strict=True))
        columns, timing = (
            {name: store.measured(file) for name, store in stores.items()}
            for file in (EVALUATION, TIMING)
        )
    return Evaluation(wanted, numbers, columns, timing, parameters, facts)


def _qualified(factory: Factory) -> str:
    """A factory's name, as far as it has one."""
    inner = getattr(factory, "func", factory)
    arguments = f"{getattr(factory, 'args', '')}{getattr(factory, 'keywords', '')}"
    return f"{inner.__module__}:{getattr(inner, '__qualname__', type(inner).__name__)}{arguments}"


def named_controllers(
    controllers: Mapping[str, Factory | str] | Sequence[str],
) -> dict[str, Factory | str]:
    """Controllers by name from SPEC or NAME=SPEC; raises EvaluationError if invalid."""
    if isinstance(controllers, Mapping):
        return dict(controllers)
    if isinstance(controllers, str):
        raise EvaluationError("controllers must be a list of names, or a mapping, not a text")
    named: dict[str, Factory | str] = {}
    for item in controllers:
        name, equals, text = (part.strip() for part in item.partition("="))
        source = text if equals else name
        name = Path(name).stem if name.endswith(".toml") else name
        if not name or not source:
            raise EvaluationError(f"controllers: '{item}' is not NAME=CONTROLLER")
        if name in named:
            raise EvaluationError(f"two controllers are called '{name}'; write NAME=… for one")
        named[name] = source
    return named


def _check(controllers: Mapping[str, Factory | str], seeds: Sequence[int], steps: int) -> None:
    if not controllers:
        raise EvaluationError("no controller to evaluate")
    own = controllers.get(OPTIMAL, OPTIMAL)
    if isinstance(own, str) and own != OPTIMAL:
        raise EvaluationError(f"'{OPTIMAL}' names the controller that gives J*, not '{own}'")
    if not seeds:
        raise EvaluationError("no seed to evaluate on; give at least one")
    if len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise EvaluationError("seeds must be distinct and not negative")
    if max(seeds) >= 1 << 64:
        raise EvaluationError(f"seeds must be below 2⁶⁴; the last one is {max(seeds)}")
    if steps < 1:
        raise EvaluationError(f"steps must be at least 1, not {steps}")


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Result):
    """Indicators of controllers × seeds on common random numbers.

    `columns` and `timing` hold the measurements by controller: a frame with a row for each seed.
    `parameters` are each controller's hash; `facts` are the columns that do not vary.
    """

    controllers: Sequence[str]
    seeds: Sequence[int]
    columns: Mapping[str, pd.DataFrame]
    timing: Mapping[str, pd.DataFrame]
    parameters: Mapping[str, str]
    facts: Mapping[str, Any]

    def _facts(self) -> dict[str, object]:
        known = {f"J of {name}": float(self.column(name, "J").mean()) for name in self.controllers}
        if self.optimum is not None:
            known["J*"] = float(self.optimal.mean())
        facts = {name: self.facts[name] for name in ("scenario", "steps")}
        return facts | {"seeds": len(self.seeds)} | known

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
        """An indicator of a controller over the seeds, (S,); raises EvaluationError on others."""
        for word, known in ((controller, self.columns), (name, next(iter(self.columns.values())))):
            if word not in known:
                raise EvaluationError(f"there is no '{word}'{instead(word, map(str, known))}")
        return np.asarray(self.columns[controller][name])

    def _cost(self, controller: str) -> Array:
        """J over the seeds, (S,), NaN of a controller that was not evaluated."""
        there = controller in self.columns
        return self.column(controller, "J") if there else np.full(len(self.seeds), np.nan)

    def to_pandas(self) -> pd.DataFrame:
        """A row for each controller, as given, and seed; NaN where an indicator is undefined."""
        frame = self._rows(self.columns).assign(**self.facts)
        cost, names = frame.J.to_numpy(), (NAIVE, OPTIMAL, self.reference)
        naive, optimal, reference = (np.tile(self._cost(n), len(self.controllers)) for n in names)
        frame["parameters_hash"] = frame.controller.map(self.parameters)
        frame["regret"] = statistics.regrets(cost, optimal)
        frame["gap_closed"] = statistics.gaps_closed(cost, naive, optimal)
        frame["gain_in_J"] = statistics.gains(cost, reference)
        return frame[COLUMNS].astype({"failures": int})

    def _rows(self, frames: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
        rows = pd.concat({name: frames[name] for name in self.controllers})
        return rows.rename_axis(["controller", "seed"]).reset_index()

    def to_csv(self) -> str:
        """The table as CSV; floats read back to the same bits, undefined ones are empty."""
        return to_csv(self.to_pandas())

    def figure(self) -> Figure:
        """Regret (J where J* is not known) with its intervals; economic cost against violation."""
        from cosim.figures.evaluation import evaluation_figure  # noqa: PLC0415 - matplotlib

        return evaluation_figure(
            {name: self.columns[name] for name in self.controllers},
            title=f"{self.facts['scenario']}, {self.facts['steps']} samples × {len(self.seeds)} "
            "seeds, the same disturbances for all",
            optimal=None if self.optimum is None else self.optimal,
        )

    def table(self) -> str:
        """Means over the seeds by controller, as a Markdown table; a regret of 1 is 100 %."""
        names = ["J", "regret", "economic_cost", "violating_share", "failures"]
        means = self.to_pandas().groupby("controller", sort=False)[names].mean()
        rows = means.map("{:.6g}".format).reset_index().to_numpy().tolist()
        return markdown_table(("controller", *names), rows)

    def write(self, folder: Path) -> None:
        """Write evaluation.csv, evaluation.png and timing.csv, each whole or not at all."""
        self.plot(folder / "evaluation.png")
        clock = self._rows(self.timing).round(3)
        for name, frame in ((EVALUATION, self.to_pandas()), (TIMING, clock)):
            # Write row by row: the text of all takes ten times the memory of the numbers.
            with replacing(folder / name) as path:
                frame.to_csv(path, index=False, lineterminator="\n")

    def summary(self) -> dict[str, Any]:
        """The evaluation as a JSON document: controllers, comparisons, provenance, timing.

        `controllers`: per controller the means over all seeds and samples, the `intervals` of each
        mean, and `failures` in total. Where J* is known there is the `regret` (J − J*)/|J*|, and
        with the naive controller `gap_closed` = (J_naive − J)/(J_naive − J*). `comparisons`: for
        each pair, the paired difference controller − reference of each mean, and `gain_in_J`,
        (J_ref − J)/|J_ref|. Every interval is of 95 %, paired over seeds, `interval` Student's and
        `bootstrap` BCa. `optimal_J` is J* on the same seeds.
        """
        return {
            **self.facts,
            "seeds": list(self.seeds),
            "reference": self.reference,
            "optimum": self.optimum,
            "optimal_J": None if self.optimum is None else float(np.mean(self.optimal)),
            "controllers": {name: self._controller(name) for name in self.controllers},
            "comparisons": [
                self._comparison(name, reference)
                for i, name in enumerate(self.controllers)
                for reference in self.controllers[:i]
            ],
            "timing": {name: self.timing[name].median().to_dict() for name in self.controllers},
        }

    def _controller(self, name: str) -> dict[str, Any]:
        estimates = {key: statistics.mean(self.column(name, key))._asdict() for key in MEANS}
        document: dict[str, Any] = {key: one.pop("value") for key, one in estimates.items()}
        document |= {
            "failures": int(np.sum(self.column(name, "failures"))),
            "parameters_hash": self.parameters[name],
            "intervals": estimates,
        }
        cost, best = self._cost(name), self.optimal
        if self.optimum is not None:
            resampled = statistics.bootstrapped(cost - best, statistics.magnitude(best))
            found = statistics.regret(cost, best)._asdict()
            document["regret"] = found | {"bootstrap": resampled}
            if NAIVE in self.controllers:
                gap = statistics.gap_closed(cost, self._cost(NAIVE), best)
                document["gap_closed"] = gap._asdict()
        return document

    def _comparison(self, name: str, reference: str) -> dict[str, Any]:
        cost, other = self._cost(name), self._cost(reference)
        resampled = statistics.bootstrapped(other - cost, statistics.magnitude(other))
        return {
            "controller": name,
            "reference": reference,
            "differences": {
                key: statistics.mean(self.column(name, key) - self.column(reference, key))._asdict()
                for key in COMPARED
            },
            "gain_in_J": statistics.gain(cost, other)._asdict() | {"bootstrap": resampled},
        }


TOLERANCE = 1e-6
"""Largest difference of a state from the one played back, relative to 1 + its magnitude."""


class _Recorded:
    """Plays recorded actions back and holds the recorded states to the plant's."""

    name = "recorded"

    def __init__(self, path: Path, states: pd.DataFrame, actions: Array) -> None:
        self._path, self._states, self._actions = path, states, actions
        self._k = -1

    def reset(self) -> None:
        self._k = -1

    def prepare(self) -> None:
        self._k += 1

    def feedback(self, s: Array, a: object = None) -> Decision:
        """The sample's action; raises EvaluationError if the state belongs to other noise."""
        for (name, column), expected in zip(self._states.items(), s.tolist(), strict=True):
            found = float(column.iloc[self._k])
            if not abs(found - expected) <= TOLERANCE * (1 + abs(expected)):
                raise EvaluationError(
                    f"'{self._path}': {name} at sample {self._k} is {found!r}; the seed's noise "
                    f"under these actions gives {expected!r} (cosim scenario NAME --seed-values K "
                    "prints the plant's start values)"
                )
        return Decision(self._actions[self._k])


def judge(scenario: Scenario, folder: Path) -> pd.DataFrame:
    """A row of indicators for each ``*.csv`` of a folder, whose name ends in the run's seed.

    A file has a column for each state and action of the scenario by name (a unit in brackets may
    follow) and a row a sample: the state, and the action then applied. The actions are played back
    on the seed's noise, and the file's states are checked against it; the figures are those of the
    playback. Columns `file`, `scenario` and its hash, `seed`, `steps`, `indicators`', and `optimum`
    and `regret`, J of the stored optimum on the same noise, NaN without one. Raises EvaluationError
    with file, sample and both values.
    """
    paths = sorted(folder.glob("*.csv"))
    if not paths:
        raise EvaluationError(f"'{folder}' holds no .csv file")
    best, rows = stored_optimum(scenario), []
    optimum = None if best is None else build_controller(best, scenario)
    with FmuPlant(scenario) as plant:
        for path in paths:
            seed, recorded, steps = _read(path, scenario)
            row: dict[str, Any] = {"file": path.name, "scenario": scenario.name}
            row |= {"scenario_hash": scenario.hash, "seed": seed, "steps": steps}
            row |= indicators(simulate(plant, recorded, steps, seed, residuals=False))
            cost = np.nan if optimum is None else measure(plant, optimum, seed, steps)[0]["J"]
            rows.append(row | {"optimum": cost, "regret": row["J"] / cost - 1})
    return pd.DataFrame(rows).sort_values("seed", ignore_index=True)


def _read(path: Path, scenario: Scenario) -> tuple[int, _Recorded, int]:
    number = re.search(r"(\d+)$", path.stem)
    if number is None:
        raise EvaluationError(f"'{path}': a file's name ends in its seed, as run-7.csv")
    try:
        table = pd.read_csv(path)
        table = table.rename(columns=lambda title: title.partition(" [")[0].strip())
        plant = scenario.plant
        numbers = table[[*plant.states, *plant.actions]].astype(float)
    except (OSError, ValueError, KeyError) as error:
        raise EvaluationError(f"'{path}' is no trajectory: {error}") from None
    actions = numbers[list(plant.actions)].to_numpy()
    inside = (actions >= scenario.action_lower) & (actions <= scenario.action_upper)
    if not len(actions) or not inside.all():
        k = 0 if not len(actions) else int(np.argmin(inside.all(axis=1)))
        raise EvaluationError(f"'{path}': the action at sample {k} is missing or beyond its bounds")
    return int(number[1]), _Recorded(path, numbers[list(plant.states)], actions), len(actions)
