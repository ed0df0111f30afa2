"""`Study`: the cases to compare. `plan`: its runs and their dependencies."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, Self, TypeVar, get_args, get_origin

from controllers.optimum import stored_optimum
from cosim.core.errors import StudyError
from cosim.core.modules import import_from
from cosim.core.plugins import ControllerSource
from cosim.core.scenario import Scenario, resolved
from cosim.core.validation import instead, validated
from cosim.evaluation import EVALUATION
from cosim.identity import code_hash, versions
from cosim.measurement import Noise
from cosim.plant import FmuPlant
from cosim.studies.document import DEFAULT, CaseTable, StudyTable, TrajectoryTable, read
from cosim.studies.run import (
    GREEDY,
    LOG,
    PARAMETERS,
    Run,
    Training,
    functions_for,
    safe,
)
from cosim.workers import Conditions
from learning.algorithm import load_algorithm
from learning.errors import ConfigurationError
from learning.training_run import HELD_OUT, make_run

BASELINES, NAIVE = "baselines", "naive"
TRAJECTORIES, LOGS, THETA = "trajectories", "logs", "parameters"
"""Folders of what a study keeps of its runs."""
ROW, CHECKPOINT = 500, 5000
"""Most samples between two rows of a log, and about those between two checkpoints."""
MOST_SAMPLES = 100_000_000
"""Samples of the longest run."""
TRAINING_OPTIONS = (
    "log_every", "evaluate_every", "checkpoint_every", "evaluation_seeds", "evaluation_steps",
    "divergence", "rest_after",
)  # fmt: skip
"""What a case's table `training` may say."""
T = TypeVar("T")
SEQUENCES = (list, tuple, set, frozenset)


@dataclass(frozen=True)
class Case:
    """One point of a grid: a controller, or an algorithm with one set of settings.

    `scenarios` are names; `training_seeds` is empty for a controller. `group` is the panel of the
    figures that shows it; `against` the case that its paired difference is taken from.
    """

    name: str
    scenarios: tuple[str, ...]
    group: str
    controller: str | None = None
    algorithm: str | None = None
    samples: int = 0
    start: str = ""
    nmpc: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    training_seeds: tuple[int, ...] = ()
    against: str | None = None

    @property
    def target(self) -> str:
        """The algorithm or the controller."""
        return self.algorithm or self.controller or ""


class Study:
    """Cases × scenarios × training seeds, and the noise that they are compared on.

    `load` reads a study file, `from_dict` takes the same document; `cosim.study` runs it. Relative
    paths and `module:Class` names are looked up from `folder`; `file` is its file as given. Raises
    StudyError, ScenarioError and, of an algorithm, LearningError.
    """

    def __init__(self, table: StudyTable, folder: Path, file: str | None = None) -> None:
        self.table, self.file = table, file
        self.folder = folder.resolve()
        import_from(self.folder)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a study file; raises StudyError."""
        return cls(read(path), Path(path).resolve().parent, str(path))

    @classmethod
    def from_dict(cls, document: Mapping[str, Any], folder: str | Path = ".") -> Self:
        """Validate a document, structured like the TOML file; raises StudyError."""
        return cls(validated(StudyTable, dict(document), "study", StudyError), Path(folder))

    @property
    def name(self) -> str:
        """The study's name."""
        return self.table.name

    @property
    def depends_on(self) -> dict[str, str]:
        """Paths of the data files that its plug-ins read, by name; StudyError if one is missing."""
        paths = {f"file {name}": self.folder / name for name in self.table.depends_on}
        for path in paths.values():
            if not path.is_file():
                raise StudyError(f"depends_on: there is no file '{path}'")
        return {name: str(path) for name, path in paths.items()}

    @cached_property
    def scenarios(self) -> dict[str, Scenario]:
        """Scenarios by name, in the study's order."""
        own = {}
        for document in self.table.scenario:
            where = f"study '{self.name}', [[scenario]]"
            scenario = Scenario.from_dict(resolved(document, where, self.folder), where)
            own[scenario.name] = scenario
        found: dict[str, Scenario] = {}
        for source in self.table.scenarios:
            path = self.folder / source if source.endswith(".toml") else source
            scenario = own.get(source) or Scenario.load(path)
            if scenario.name in found:
                raise StudyError(
                    f"two scenarios are called '{scenario.name}'; their files' name must differ"
                )
            found[scenario.name] = scenario
        return found

    @cached_property
    def cases(self) -> list[Case]:
        """Every case, grids written out."""
        cases = [case for table in self.table.case for case in self._expanded(table)]
        names = [case.name for case in cases]
        if twice := [name for name in names if names.count(name) > 1]:
            raise StudyError(f"two cases are called '{twice[0]}'; give each another name")
        met = [seed for case in cases for seed in case.training_seeds]
        for scenario in self.scenarios:
            held_out, own = self.held_out(scenario).seeds, self.noise(scenario).seeds
            for seeds, what in ((met, "a training seed"), (held_out, "a seed of the curves")):
                if common := sorted(set(seeds) & set(own)):
                    raise StudyError(
                        f"evaluation: noise seed {common[0]} is {what} too; choose another "
                        "first_seed"
                    )
        return cases

    def _expanded(self, table: CaseTable) -> Iterator[Case]:
        """The points of a case's grid."""
        scenarios = tuple(self.scenarios if table.scenarios is None else table.scenarios)
        _check_known(scenarios, self.scenarios, f"case '{table.name}'", "scenario")
        if table.algorithm is None:
            given = table.controller or ""
            for source in (sources := given if isinstance(given, list) else [given]):
                own = Path(source).stem if source.endswith(".toml") else source.replace(":", ".")
                name = f"{table.name}({own})" if table.name and sources[1:] else table.name or own
                group = table.group or BASELINES
                yield Case(name, scenarios, group, controller=source, against=table.against)
            return
        grid = {"samples": table.samples, "start": table.start, "nmpc": table.nmpc}
        axes: dict[str, list[Any]]
        axes = {k: v if isinstance(v, list) else [v] for k, v in grid.items()}
        axes |= {k: _axis(table.algorithm, k, v) for k, v in table.settings.items()}
        if empty := [key for key, values in axes.items() if not values]:
            raise StudyError(f"case '{table.name}': the grid of {empty[0]} is empty")
        varied = [key for key, values in axes.items() if len(values) > 1]
        seeds = table.training_seeds or self.table.training_seeds
        for values in product(*axes.values()):
            point = dict(zip(axes, values, strict=True))
            label = " ".join(f"{key}={_text(point[key])}" for key in varied)
            yield Case(
                name=f"{table.name}({label})" if label else str(table.name),
                scenarios=scenarios,
                group=table.group or table.algorithm.rpartition(":")[2],
                algorithm=table.algorithm,
                **{axis: point.pop(axis) for axis in grid},
                settings=point,
                training=dict(table.training),
                training_seeds=tuple(range(seeds.first, seeds.first + seeds.count)),
                against=table.against,
            )

    def located(self, source: str) -> str:
        """A parameters file's path, given from the study's folder; other names as they are."""
        return str(self.folder / source) if source.endswith(".toml") else source

    def counterpart(self, case: Case) -> str | None:
        """Name of the case that a case's paired difference is taken from; raises StudyError.

        In a grid it is the counterpart's point of the same label, where there is one.
        """
        if case.against is None:
            return None
        names = [other.name for other in self.all_cases]
        label = case.name[case.name.index("(") :] if "(" in case.name else ""
        for name in (case.against, f"{case.against}{label}"):
            if name in names and name != case.name:
                return name
        raise StudyError(
            f"case '{case.name}': there is no other case '{case.against}'"
            f"{instead(case.against, names)}"
        )

    @cached_property
    def optima(self) -> dict[str, str]:
        """Names of the cases whose J is J*, by scenario; scenarios without one are not there."""
        return {
            name: self.named(optimum)
            for name, scenario in self.scenarios.items()
            if (optimum := stored_optimum(scenario)) is not None
        }

    @cached_property
    def references(self) -> list[Case]:
        """Controllers for regret and gap that the study lacks: naive, optimal."""
        given = {case.controller for case in self.cases}
        wanted: dict[str, list[str]] = {}
        for name, scenario in self.scenarios.items():
            if NAIVE not in given and scenario.controller.model is not None:
                wanted.setdefault(NAIVE, []).append(name)
            if name in self.optima and self.optima[name] not in given:
                wanted.setdefault(self.optima[name], []).append(name)
        return [
            Case(name, tuple(scenarios), BASELINES, controller=name)
            for name, scenarios in wanted.items()
        ]

    @property
    def all_cases(self) -> list[Case]:
        """References and cases, in the order of the tables."""
        return [*self.references, *self.cases]

    def named(self, controller: str) -> str:
        """A controller's name in the tables: the one that the study gives, else its own."""
        return next((c.name for c in self.cases if c.controller == controller), controller)

    def noise(self, scenario: str) -> Noise:
        """Noise on which the cases of a scenario are compared."""
        table = self.table.evaluation
        count = self._of(table.seeds, scenario, "evaluation.seeds")
        seeds = tuple(range(table.first_seed, table.first_seed + count))
        return Noise(seeds, self._of(table.steps, scenario, "evaluation.steps"), table.burn_in)

    def held_out(self, scenario: str) -> Noise:
        """Noise of the greedy evaluations during training."""
        count = self._of(self.table.curves.seeds, scenario, "curves.seeds")
        steps = self._of(self.table.curves.steps, scenario, "curves.steps")
        return Noise(tuple(range(HELD_OUT, HELD_OUT + count)), steps)

    def marks(self, scenario: str) -> tuple[int, ...]:
        """Samples of operation at which a scenario's runs are judged; else empty."""
        if self.table.operation is None:
            return ()
        hours = self._of(self.table.operation.hours, scenario, "operation.hours")
        return self.samples_of(hours, scenario)

    def samples_of(self, hours: Sequence[float], scenario: str) -> tuple[int, ...]:
        """Hours of operation as samples, increasing."""
        h = self.scenarios[scenario].sampling_time
        samples = sorted({max(1, round(3600.0 * hour / h)) for hour in hours})
        if samples and samples[-1] > MOST_SAMPLES:
            raise StudyError(
                f"operation.hours: {max(hours):g} h are {samples[-1]} samples of '{scenario}'; a "
                f"run has at most {MOST_SAMPLES}"
            )
        return tuple(samples)

    def _of(self, value: T | dict[str, T], scenario: str, field: str) -> T:
        if not isinstance(value, dict):
            return value
        _check_known(value, [*self.scenarios, DEFAULT], field, "scenario")
        number = value.get(scenario, value.get(DEFAULT))
        if number is None:
            raise StudyError(f"{field}: has no number for '{scenario}', and no '{DEFAULT}'")
        return number

    def training(self, case: Case, scenario: str, seed: int) -> dict[str, Any]:
        """The `training` of a case's run on a scenario; raises ConfigurationError."""
        assert case.algorithm is not None
        curves, samples = self.held_out(scenario), case.samples
        if marks := self.marks(scenario):
            samples = marks[-1]
            if (asked := load_algorithm(case.algorithm).requires) != "operation":
                raise ConfigurationError(
                    f"case '{case.name}': '{case.algorithm}' requires a {asked}, and a study in "
                    "operation has none"
                )
        between = max(1, samples // self.table.curves.points)
        rows = -(-between // ROW)
        log_every = max(1, between // rows)
        own = {"seed": seed, "controller": case.nmpc, "start": self.located(case.start)}
        if twice := sorted(own.keys() & case.training):
            raise ConfigurationError(f"training: {twice[0]} is given by the study itself")
        _check_known(case.training, TRAINING_OPTIONS, "training", "option")
        options = {
            **own,
            "log_every": log_every,
            "evaluate_every": rows * log_every,
            "checkpoint_every": log_every * max(1, round(CHECKPOINT / log_every)),
            "evaluation_seeds": len(curves.seeds),
            "evaluation_steps": curves.steps,
            **case.training,
        }
        found = {"algorithm": case.algorithm, "samples": samples}
        return found | {"settings": dict(case.settings), "options": options}


@dataclass(frozen=True)
class StudyPlan:
    """The runs of a study: controllers first, then seed by seed."""

    definition: Study
    runs: list[Run]
    provenance: dict[str, Any]

    @property
    def samples(self) -> int:
        """Plant samples of all runs."""
        return sum(run.samples for run in self.runs)


def plan(study: Study) -> StudyPlan:
    """The runs of a study; every mistake in it is raised here, before the work."""
    plants = {}
    for name, described in study.scenarios.items():
        with FmuPlant(described) as plant:
            plants[name] = {"scenario": described.hash, "fmu": plant.fmu_sha256}
    content: dict[tuple[str, str], _Content] = {}
    runs = []
    # Controllers first, then seed after seed: stopped early, every case has fewer seeds.
    met = sorted({seed for case in study.cases for seed in case.training_seeds})
    for seed, name, case in product((None, *met), study.scenarios, study.all_cases):
        if seed not in (case.training_seeds or (None,)) or name not in case.scenarios:
            continue
        if (case.name, name) not in content:
            content[case.name, name] = _read(study, case, name)
        runs.append(_run(study, case, name, seed, content[case.name, name]))
    _check_names(study)
    about = {"versions": versions(), "code_hash": code_hash()}
    return StudyPlan(study, runs, about | {"scenarios": plants, "study": study.name})


@dataclass(frozen=True)
class _Content:
    """What the runs of a case on a scenario have in common, as it was read.

    `theta` is the text of its θ file: of the controller, or of the start of a training.
    """

    conditions: Conditions
    controller: ControllerSource
    theta: str | None


def _read(study: Study, case: Case, name: str) -> _Content:
    """Read what a case needs; raises what a wrong case would raise in its run."""
    scenario = study.scenarios[name]
    controller = ControllerSource.read(study.located(case.controller or case.start))
    if case.algorithm is not None:
        arguments = study.training(case, name, 0)
        options = arguments.pop("options")
        make_run(scenario=scenario, **arguments, **options)
    elif ":" in (case.controller or ""):
        controller.build(scenario)
    conditions = Conditions.of_now(scenario, case.target, files=study.depends_on)
    return _Content(conditions, controller, controller.theta)


def _run(study: Study, case: Case, name: str, seed: int | None, content: _Content) -> Run:
    """A case's run on a scenario."""
    marks = study.marks(name) if seed is not None or case.name == study.optima.get(name) else ()
    training = None
    if seed is not None:
        training = Training(study.training(case, name, seed), content.theta, marks)
    noise, at_marks = _noise(study, case, name, seed, marks)
    facts: dict[str, Any] = {**content.conditions.facts, "functions": functions_for(noise)}
    if content.theta is not None:
        text = content.theta.encode()
        facts[Path(content.controller.name).name] = hashlib.sha256(text).hexdigest()
    if training is None:
        facts["controller"] = case.controller
    else:  # as the file says, so that results depend on no folder
        options = training.arguments["options"] | {"start": case.start}
        facts["training"] = {**training.arguments, "options": options}
    return Run(
        conditions=content.conditions,
        case=case.name,
        facts=facts,
        noise=noise,
        controller=content.controller if training is None else None,
        seed=seed,
        training=training,
        kept=_kept(study, case, name, seed),
        marks=at_marks,
    )


def _noise(
    study: Study, case: Case, name: str, seed: int | None, marks: Iterable[int]
) -> tuple[dict[str, Noise], dict[str, int]]:
    """Noise of a run's evaluations by file, and the mark of operation of those that have one."""
    noise = {EVALUATION: study.noise(name)}
    others = [other for other in study.cases if name in other.scenarios]
    if seed is None and any(other.algorithm for other in others):
        noise[GREEDY] = study.held_out(name)
    at_mark = study.held_out(name)._replace(burn_in=noise[EVALUATION].burn_in)
    at_marks = {f"greedy-{mark}.csv": mark for mark in marks}
    noise |= dict.fromkeys(at_marks, at_mark)
    for table in _trajectories(study, case, name, seed):
        noise[table.file] = Noise((table.seed,), table.steps, whole=True)
    seeds = tuple(sorted({one for other in others for one in other.training_seeds}))
    if seed is None and seeds:  # the optimum, on the noise of the training seeds
        noise |= {f"online-{mark}.csv": Noise(seeds, mark) for mark in marks}
    return noise, at_marks


def _is_first(case: Case, seed: int | None) -> bool:
    """Whether a run is the one of its case whose files are kept."""
    return seed in (None, *case.training_seeds[:1])


def _trajectories(
    study: Study, case: Case, name: str, seed: int | None
) -> Iterator[TrajectoryTable]:
    """The trajectories that a run is asked for."""
    for table in study.table.trajectory:
        wanted = case.name in (table.cases or [case.name])
        if wanted and name in (table.scenarios or [name]) and _is_first(case, seed):
            yield table


def _kept(study: Study, case: Case, name: str, seed: int | None) -> dict[str, str]:
    """Where the study keeps a copy of a run's files, by file."""
    where, stem = safe(name), safe(case.name)
    kept = {
        table.file: f"{TRAJECTORIES}/{table.name}/{where}/{stem}.csv"
        for table in _trajectories(study, case, name, seed)
    }
    if _is_first(case, seed) and case.name in study.table.logs:
        kept[LOG] = f"{LOGS}/{where}-{stem}.csv"
        kept[PARAMETERS] = f"{THETA}/{where}-{stem}.toml"
    return kept


def _check_names(study: Study) -> None:
    names = [case.name for case in study.all_cases]
    trained = [case.name for case in study.cases if case.algorithm is not None]
    for table in study.table.trajectory:
        _check_known(table.cases or (), names, f"trajectory '{table.name}'", "case")
    _check_known(study.table.logs, trained, "logs", "case")
    if (operation := study.table.operation) is not None:
        _check_known(operation.drawn, trained, "operation.drawn", "case")
    for case in study.cases:
        study.counterpart(case)


def _check_known(words: Iterable[str], known: Iterable[str], where: str, kind: str) -> None:
    for word in words:
        if word not in known:
            raise StudyError(f"{where}: there is no {kind} '{word}'{instead(word, known)}")


def _is_sequence(annotation: Any) -> bool:
    if get_origin(annotation) in SEQUENCES or annotation in SEQUENCES:
        return True
    return any(_is_sequence(part) for part in get_args(annotation) if part is not Ellipsis)


def _axis(algorithm: str, setting: str, value: Any) -> list[Any]:
    """Values of a setting: a list is a grid, but for a setting that is a list itself."""
    if not isinstance(value, list):
        return [value]
    field = load_algorithm(algorithm).Configuration.model_fields.get(setting)
    nested = bool(value) and all(isinstance(item, list) for item in value)
    return value if nested or field is None or not _is_sequence(field.annotation) else [value]


def _text(value: Any) -> str:
    return Path(value).stem if isinstance(value, str) else json.dumps(value).replace(" ", "")
