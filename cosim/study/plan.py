"""What a study has to do: its runs, the facts that each depends on, and the order of work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from cosim.errors import StudyError
from cosim.evaluation.provenance import code_hash, versions
from cosim.plant import FmuPlant
from cosim.plugins import OURS
from cosim.study.cases import Case
from cosim.study.definition import HELD_OUT, Definition, Sizes
from cosim.study.document import TrajectoryTable
from cosim.study.protocols import Training
from cosim.study.store import EVALUATION, GREEDY, Online, RunKey
from cosim.validation import suggestion

BLOCK = 20_000
"""Samples of an evaluation unit, about: a few seconds of work."""


@dataclass(frozen=True)
class Run:
    """One run: a controller, or a training and the θ that comes of it."""

    key: RunKey
    case: Case
    training: Training | None
    facts: dict[str, Any]
    sizes: Sizes
    greedy: bool
    """Whether a controller is run on the noise of the learning curves, too."""
    traces: tuple[TrajectoryTable, ...] = ()
    """Runs that are kept sample by sample."""
    online: Online | None = None
    """The noise of the trainings that a controller runs beside."""

    @property
    def noise(self) -> dict[str, tuple[tuple[int, ...], int]]:
        """Seeds and samples on each, by the file that keeps the indicators."""
        sizes = self.sizes
        found = {EVALUATION: (sizes.seeds, sizes.steps)}
        if self.greedy:
            held_out = tuple(HELD_OUT + k for k in range(sizes.curve_seeds))
            found[GREEDY] = (held_out, sizes.curve_steps)
        return found

    @property
    def samples(self) -> int:
        """Plant samples of the run, validation apart."""
        trained = 0 if self.training is None else self.training.samples
        evaluated = sum(len(seeds) * steps for seeds, steps in self.noise.values())
        beside = 0 if self.online is None else len(self.online.seeds) * self.online.steps
        return trained + evaluated + beside + sum(trace.steps for trace in self.traces)


@dataclass(frozen=True)
class Plan:
    """The runs of a study, those first that the others are compared with, then seed by seed."""

    definition: Definition
    runs: list[Run]
    provenance: dict[str, Any]

    @property
    def samples(self) -> int:
        """Plant samples of all runs."""
        return sum(run.samples for run in self.runs)


def plan(definition: Definition) -> Plan:
    """Everything that a study has to do, checked; raises what scenarios and trainer raise."""
    code = code_hash(OURS)
    plants = {}
    for name, described in definition.scenarios.items():
        with FmuPlant(described) as plant:
            plants[name] = {"scenario": described.hash, "fmu": plant.fmu_sha256}
    sources = {
        case.target: dict(definition.trainer.sources(case.target))
        for case in [*definition.references, *definition.cases]
    }
    runs = []
    for case, scenario, seed in _order(definition):
        training = None if seed is None else definition.training(case, scenario, seed)
        facts: dict[str, Any] = {
            **plants[scenario],
            "sources": sources[case.target],
            "code": code,
        }
        if training is None:
            facts["controller"] = definition.relative(case.controller or "")
        else:
            facts["training"] = asdict(training) | {
                "scenario": scenario,
                "start": definition.relative(training.start),
            }
            if case.start.endswith(".toml"):
                facts["start"] = dict(definition.trainer.sources(case.start))
        key = RunKey(scenario, case.name, seed)
        curves = training is None and _learns(definition, scenario)
        sizes, traces = definition.sizes(scenario), _traces(definition, case, scenario, seed)
        online = None if training is not None else _online(definition, case, scenario)
        runs.append(Run(key, case, training, facts, sizes, curves, traces, online))
    _check(definition, runs)
    provenance = {
        "versions": versions(),
        "code_hash": code,
        "scenarios": plants,
        "study": definition.name,
    }
    return Plan(definition, runs, provenance)


def _traces(
    definition: Definition, case: Case, scenario: str, seed: int | None
) -> tuple[TrajectoryTable, ...]:
    """The trajectories that a run takes part in: of a training, that of the first seed."""
    if case.training_seeds and seed != case.training_seeds[0]:
        return ()
    return tuple(
        table
        for table in definition.table.trajectory
        if case.name in (table.cases or [case.name]) and scenario in (table.scenarios or [scenario])
    )


def _online(definition: Definition, controller: Case, scenario: str) -> Online | None:
    """The trainings that a controller of the study, or the optimum, runs beside."""
    trained = [case for case in definition.cases if case.algorithm and scenario in case.scenarios]
    wanted = controller in definition.cases or controller.name == definition.optima.get(scenario)
    if definition.table.online is None or not trained or not wanted:
        return None
    seeds = sorted({seed for case in trained for seed in case.training_seeds})
    steps = max(case.samples for case in trained)
    return Online(tuple(seeds), steps, definition.table.online.block)


def _learns(definition: Definition, scenario: str) -> bool:
    return any(case.algorithm and scenario in case.scenarios for case in definition.cases)


def _order(definition: Definition) -> Iterator[tuple[Case, str, int | None]]:
    """Controllers first, then seed after seed: stopped early, every case has fewer seeds."""
    cases = [*definition.references, *definition.cases]
    for scenario in definition.scenarios:
        for case in cases:
            if case.algorithm is None and scenario in case.scenarios:
                yield case, scenario, None
    trained = [case for case in cases if case.algorithm is not None]
    for seed in sorted({seed for case in trained for seed in case.training_seeds}):
        for scenario in definition.scenarios:
            for case in trained:
                if seed in case.training_seeds and scenario in case.scenarios:
                    yield case, scenario, seed


def _check(definition: Definition, runs: list[Run]) -> None:
    """Find every mistake before the work: names of cases, algorithms, settings, folders."""
    names = [case.name for case in [*definition.references, *definition.cases]]
    trained = [case.name for case in definition.cases if case.algorithm is not None]
    asked = [
        (f"trajectory '{t.name}'", c, names)
        for t in definition.table.trajectory
        for c in t.cases or []
    ]
    asked += [("logs", case, trained) for case in definition.table.logs]
    for where, name, known in asked:
        if name not in known:
            raise StudyError(
                f"{where}: there is no case '{name}'{suggestion(name, known)}; there are "
                f"{', '.join(known)}"
            )
    folders: dict[str, RunKey] = {}
    checked = set()
    for run in runs:
        folder = str(run.key.folder).lower()
        if folder in folders:
            raise StudyError(
                f"'{run.key}' and '{folders[folder]}' would have the same folder; give one another "
                "name"
            )
        folders[folder] = run.key
        if run.training is not None and (run.key.case, run.key.scenario) not in checked:
            checked.add((run.key.case, run.key.scenario))
            definition.trainer.check(run.training)
