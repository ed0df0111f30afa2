"""`Study`: the cases to compare. `plan`: its runs and their dependencies."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, Self, TypeVar, get_args, get_origin

from controllers.optimum import stored_optimum
from cosim.core.errors import StudyError
from cosim.core.modules import import_from
from cosim.core.plugins import ControllerSource
from cosim.core.scenario import Scenario, resolved
from cosim.core.training_options import HELD_OUT, LOG, OPTION_NAMES, PARAMETERS, TrainingOptions
from cosim.core.validation import instead, validated
from cosim.evaluation import EVALUATION
from cosim.identity import code_hash, versions
from cosim.measurement import Noise
from cosim.plant import FmuPlant
from cosim.studies.document import DEFAULT, CaseTable, StudyTable, TrajectoryTable, read
from cosim.studies.run import GREEDY, Run, TrainingJob, folder_name, functions_for
from cosim.workers import Conditions
from learning.algorithm import load_algorithm
from learning.errors import ConfigurationError

BASELINES, NAIVE = "baselines", "naive"
TRAJECTORIES, LOGS, THETA = "trajectories", "logs", "parameters"
"""Folders of what a study keeps of its runs."""
MOST_BETWEEN_ROWS = 500
"""Samples between two rows of a log, at most."""
BETWEEN_CHECKPOINTS = 5000
"""Samples between two checkpoints, about."""
MOST_SAMPLES = 100_000_000
"""Samples of the longest run."""
GIVEN_BY_STUDY = ("controller", "seed", "start")
"""Options of a training that a case's table `training` may not say."""
GRID_FIELDS = ("samples", "start", "nmpc")
"""Fields of a case, beside its settings, that may be a grid."""
Choice = TypeVar("Choice")
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
        written_here = {}
        for document in self.table.scenario:
            where = f"study '{self.name}', [[scenario]]"
            scenario = Scenario.from_dict(resolved(document, where, self.folder), where)
            written_here[scenario.name] = scenario
        scenarios: dict[str, Scenario] = {}
        for source in self.table.scenarios:
            path = self.folder / source if source.endswith(".toml") else source
            scenario = written_here.get(source) or Scenario.load(path)
            if scenario.name in scenarios:
                raise StudyError(
                    f"two scenarios are called '{scenario.name}'; their files' name must differ"
                )
            scenarios[scenario.name] = scenario
        return scenarios

    @cached_property
    def cases(self) -> list[Case]:
        """Every case, grids written out."""
        cases: list[Case] = []
        for table in self.table.case:
            cases += self._controllers(table) if table.algorithm is None else self._grid(table)
        names = [case.name for case in cases]
        for name in names:
            if names.count(name) > 1:
                raise StudyError(f"two cases are called '{name}'; give each another name")
        training_seeds: set[int] = set()
        for case in cases:
            training_seeds.update(case.training_seeds)
        for scenario in self.scenarios:
            evaluation_seeds = set(self.noise(scenario).seeds)
            self._check_unmet(evaluation_seeds & training_seeds, "a training seed")
            if self.has_curves:
                held_out = set(self.held_out(scenario).seeds)
                self._check_unmet(evaluation_seeds & held_out, "a seed of the curves")
        return cases

    def _check_unmet(self, common: set[int], kind: str) -> None:
        """Refuse noise that is evaluated on and met elsewhere, too; raises StudyError."""
        if common:
            raise StudyError(
                f"evaluation: noise seed {min(common)} is {kind} too; choose another first_seed"
            )

    def _scenarios_of(self, table: CaseTable) -> tuple[str, ...]:
        scenarios = tuple(self.scenarios if table.scenarios is None else table.scenarios)
        _check_known(scenarios, self.scenarios, f"case '{table.name}'", "scenario")
        return scenarios

    def _controllers(self, table: CaseTable) -> Iterator[Case]:
        """The cases of a table with one controller or several."""
        scenarios = self._scenarios_of(table)
        sources = table.controller or ""
        if not isinstance(sources, list):
            sources = [sources]
        for source in sources:
            name = Path(source).stem if source.endswith(".toml") else source.replace(":", ".")
            if table.name:
                name = f"{table.name}({name})" if len(sources) > 1 else table.name
            group = table.group or BASELINES
            yield Case(name, scenarios, group, controller=source, against=table.against)

    def _grid(self, table: CaseTable) -> Iterator[Case]:
        """The points of the grid of a table with an algorithm."""
        assert table.algorithm is not None
        scenarios = self._scenarios_of(table)
        axes: dict[str, list[Any]] = {}
        for name in GRID_FIELDS:
            value = getattr(table, name)
            axes[name] = value if isinstance(value, list) else [value]
        for name, value in table.settings.items():
            axes[name] = _axis(table.algorithm, name, value)
        for name, values in axes.items():
            if not values:
                raise StudyError(f"case '{table.name}': the grid of {name} is empty")
        varied = [name for name, values in axes.items() if len(values) > 1]
        seeds = table.training_seeds or self.table.training_seeds
        for coordinates in product(*axes.values()):
            point = dict(zip(axes, coordinates, strict=True))
            label = " ".join(f"{name}={_text(point[name])}" for name in varied)
            yield Case(
                name=f"{table.name}({label})" if label else str(table.name),
                scenarios=scenarios,
                group=table.group or table.algorithm.rpartition(":")[2],
                algorithm=table.algorithm,
                samples=point.pop("samples"),
                start=point.pop("start"),
                nmpc=point.pop("nmpc"),
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
        optima = {}
        for name, scenario in self.scenarios.items():
            optimum = stored_optimum(scenario)
            if optimum is not None:
                optima[name] = self.named(optimum)
        return optima

    @cached_property
    def references(self) -> list[Case]:
        """Controllers for regret and gap that the study lacks: naive, optimal."""
        there = {case.controller for case in self.cases}
        wanted: dict[str, list[str]] = {}
        for name, scenario in self.scenarios.items():
            if NAIVE not in there and scenario.controller.model is not None:
                wanted.setdefault(NAIVE, []).append(name)
            if name in self.optima and self.optima[name] not in there:
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

    @property
    def has_curves(self) -> bool:
        """Whether greedy evaluations have noise of their own, that of `[curves]`."""
        return self.table.operation is None or "curves" in self.table.model_fields_set

    def noise_at_marks(self, scenario: str) -> Noise:
        """Noise on which θ is evaluated at the times of operation."""
        evaluation = self.noise(scenario)
        if not self.has_curves:
            return evaluation
        return self.held_out(scenario)._replace(burn_in=evaluation.burn_in)

    def marks(self, scenario: str) -> tuple[int, ...]:
        """Samples of operation at which a scenario's runs are evaluated; else empty."""
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

    def _of(self, value: Choice | dict[str, Choice], scenario: str, field: str) -> Choice:
        if not isinstance(value, dict):
            return value
        _check_known(value, [*self.scenarios, DEFAULT], field, "scenario")
        number = value.get(scenario, value.get(DEFAULT))
        if number is None:
            raise StudyError(f"{field}: has no number for '{scenario}', and no '{DEFAULT}'")
        return number

    def training(self, case: Case, scenario: str, seed: int, theta: str | None) -> TrainingJob:
        """The training of a case's run.

        Args:
            case: one with an algorithm.
            scenario: name of the scenario.
            seed: training seed.
            theta: text of the θ file where θ starts; None for a start with a name.

        Raises:
            ConfigurationError: the algorithm has no place in the study, or an option is none.
        """
        assert case.algorithm is not None
        marks = self.marks(scenario)
        samples = case.samples
        if marks:
            samples = marks[-1]
            requires = load_algorithm(case.algorithm).requires
            if requires != "operation":
                raise ConfigurationError(
                    f"case '{case.name}': '{case.algorithm}' requires a {requires}, and a study in "
                    "operation has none"
                )
        for name in GIVEN_BY_STUDY:
            if name in case.training:
                raise ConfigurationError(f"training: {name} is given by the study itself")
        _check_known(case.training, OPTION_NAMES, "training", "option")
        options = TrainingOptions(
            seed=seed,
            start=self.located(case.start),
            controller=case.nmpc,
            **self._intervals(samples, scenario),
        )
        return TrainingJob(
            algorithm=case.algorithm,
            samples=samples,
            options=replace(options, **case.training),
            theta=theta,
            settings=case.settings,
            marks=marks,
        )

    def _intervals(self, samples: int, scenario: str) -> dict[str, int]:
        """Options of a training that has the study's number of greedy evaluations."""
        curves = self.held_out(scenario)
        between = max(1, samples // self.table.curves.points)
        rows = -(-between // MOST_BETWEEN_ROWS)
        log_every = max(1, between // rows)
        return {
            "log_every": log_every,
            "evaluate_every": rows * log_every,
            "checkpoint_every": log_every * max(1, round(BETWEEN_CHECKPOINTS / log_every)),
            "evaluation_seeds": len(curves.seeds),
            "evaluation_steps": curves.steps,
        }


@dataclass(frozen=True)
class StudyPlan:
    """The runs of a study: controllers first, then seed by seed.

    Attributes:
        definition: the study.
        runs: all of them.
        provenance: versions, hashes of our code, and of the scenarios and FMUs.
    """

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
    for name, scenario in study.scenarios.items():
        with FmuPlant(scenario) as plant:
            plants[name] = {"scenario": scenario.hash, "fmu": plant.fmu_sha256}
    # Controllers first, then seed after seed: stopped early, every case has fewer seeds.
    training_seeds: set[int] = set()
    for case in study.cases:
        training_seeds.update(case.training_seeds)
    content: dict[tuple[str, str], _Content] = {}
    runs = []
    for seed, name, case in product(
        (None, *sorted(training_seeds)), study.scenarios, study.all_cases
    ):
        if seed not in (case.training_seeds or (None,)) or name not in case.scenarios:
            continue
        if (case.name, name) not in content:
            content[case.name, name] = _read_content(study, case, name)
        runs.append(_run(study, case, name, seed, content[case.name, name]))
    _check_unique_names(study)
    provenance = {
        "versions": versions(),
        "code_hash": code_hash(),
        "scenarios": plants,
        "study": study.name,
    }
    return StudyPlan(study, runs, provenance)


@dataclass(frozen=True)
class _Content:
    """What the runs of a case on a scenario have in common, as it was read.

    Attributes:
        conditions: the scenario, and what workers must find.
        controller: the controller, or the start of a training.
        theta: text of its θ file; None where it is no file.
    """

    conditions: Conditions
    controller: ControllerSource
    theta: str | None


def _read_content(study: Study, case: Case, name: str) -> _Content:
    """Read what a case needs; raises what a wrong case would raise in its run."""
    scenario = study.scenarios[name]
    controller = ControllerSource.read(study.located(case.controller or case.start))
    if case.algorithm is not None:
        study.training(case, name, 0, controller.theta).make_run(scenario)
    elif ":" in (case.controller or ""):
        controller.build(scenario)
    conditions = Conditions.of_now(scenario, case.target, files=study.depends_on)
    return _Content(conditions, controller, controller.theta)


def _run(study: Study, case: Case, name: str, seed: int | None, content: _Content) -> Run:
    """A case's run on a scenario."""
    trained = seed is not None
    is_optimum = case.name == study.optima.get(name)
    marks = study.marks(name) if trained or is_optimum else ()
    noise, at_marks = _noise(study, case, name, seed, marks)
    facts: dict[str, Any] = {**content.conditions.facts, "functions": functions_for(noise)}
    if content.theta is not None:
        text = content.theta.encode()
        facts[Path(content.controller.name).name] = hashlib.sha256(text).hexdigest()
    training = None
    if seed is None:
        facts["controller"] = case.controller
    else:  # as the file says, so that results depend on no folder
        training = study.training(case, name, seed, content.theta)
        facts["training"] = training.facts(case.start)
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
    """Noise of a run's evaluations by file, and the mark of operation of those that have one.

    Args:
        study: the study.
        case: of the run.
        name: of its scenario.
        seed: its training seed; None of a controller.
        marks: samples of operation after which its policy is evaluated.
    """
    noise = {EVALUATION: study.noise(name)}
    cases = [other for other in study.cases if name in other.scenarios]
    if seed is None and study.has_curves and any(other.algorithm for other in cases):
        # A level for the learning curves.
        noise[GREEDY] = study.held_out(name)
    at_marks = {f"greedy-{mark}.csv": mark for mark in marks}
    for file in at_marks:
        noise[file] = study.noise_at_marks(name)
    for table in _trajectories(study, case, name, seed):
        noise[table.file] = Noise((table.seed,), table.steps, whole=True)
    training_seeds: set[int] = set()
    for other in cases:
        training_seeds.update(other.training_seeds)
    if seed is None and training_seeds:
        # The optimum, on the noise of the trainings.
        for mark in marks:
            noise[f"online-{mark}.csv"] = Noise(tuple(sorted(training_seeds)), mark)
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
    where, stem = folder_name(name), folder_name(case.name)
    kept = {}
    for table in _trajectories(study, case, name, seed):
        kept[table.file] = f"{TRAJECTORIES}/{table.name}/{where}/{stem}.csv"
    if _is_first(case, seed) and case.name in study.table.logs:
        kept[LOG] = f"{LOGS}/{where}-{stem}.csv"
        kept[PARAMETERS] = f"{THETA}/{where}-{stem}.toml"
    return kept


def _check_unique_names(study: Study) -> None:
    """Raise StudyError where a table names a case that is none."""
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
    """Raise StudyError on a word that is not known.

    Args:
        words: what the study file gives.
        known: what it may give.
        where: field of the study file.
        kind: what a word names.
    """
    for word in words:
        if word not in known:
            raise StudyError(f"{where}: there is no {kind} '{word}'{instead(word, known)}")


def _is_sequence(annotation: Any) -> bool:
    """Whether a field of this type takes a list, as one of its alternatives too."""
    if get_origin(annotation) in SEQUENCES or annotation in SEQUENCES:
        return True
    return any(_is_sequence(part) for part in get_args(annotation) if part is not Ellipsis)


def _axis(algorithm: str, setting: str, value: Any) -> list[Any]:
    """Values of a setting: a list is a grid, but for a setting that is a list itself."""
    if not isinstance(value, list):
        return [value]
    field = load_algorithm(algorithm).Configuration.model_fields.get(setting)
    nested = bool(value) and all(isinstance(item, list) for item in value)
    takes_a_list = field is not None and _is_sequence(field.annotation)
    return [value] if takes_a_list and not nested else value


def _text(value: Any) -> str:
    """A value of a grid as it stands in the name of its case."""
    return Path(value).stem if isinstance(value, str) else json.dumps(value).replace(" ", "")
