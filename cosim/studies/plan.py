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
from cosim.evaluation import EVALUATION, NAIVE
from cosim.identity import code_hash, versions
from cosim.measurement import Noise
from cosim.plant import FmuPlant
from cosim.studies.document import DEFAULT, CaseTable, StudyTable, TrajectoryTable, read
from cosim.studies.run import GREEDY, Run, TrainingJob, folder_name, functions_for
from cosim.workers import Conditions
from learning.algorithm import load_algorithm
from learning.errors import ConfigurationError

BASELINES = "baselines"
"""Group of the cases that figures show as lines to compare with."""
TRAJECTORIES = "trajectories"
"""Folder of the trajectories that a study keeps of its runs."""
LOGS = "logs"
"""Folder of the logs that it keeps."""
THETA = "parameters"
"""Folder of the θ files that it keeps."""
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
        self.table = table
        self.file = file
        # Users' modules are found from here, whatever the working directory is then.
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
        paths = {}
        for name in self.table.depends_on:
            path = self.folder / name
            if not path.is_file():
                raise StudyError(f"depends_on: there is no file '{path}'")
            paths[f"file {name}"] = str(path)
        return paths

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
            # The study's own goes before a preset of the same name.
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
        self._check_seeds(_training_seeds(cases))
        return cases

    def _check_seeds(self, training_seeds: Iterable[int]) -> None:
        """Refuse noise that is evaluated on and met elsewhere, too; raises StudyError."""
        for scenario in self.scenarios:
            met = dict.fromkeys(training_seeds, "a training seed")
            if self.has_curves:
                met |= dict.fromkeys(self.held_out(scenario).seeds, "a seed of the curves")
            for seed in self.noise(scenario).seeds:
                if seed in met:
                    raise StudyError(
                        f"evaluation: noise seed {seed} is {met[seed]} too; choose another "
                        "first_seed"
                    )

    def _scenarios_of(self, table: CaseTable) -> tuple[str, ...]:
        scenarios = tuple(self.scenarios if table.scenarios is None else table.scenarios)
        _check_known(scenarios, self.scenarios, f"case '{table.name}'", "scenario")
        return scenarios

    def _controllers(self, table: CaseTable) -> Iterator[Case]:
        """The cases of a table with one controller or several."""
        sources = table.controller or ""
        if not isinstance(sources, list):
            sources = [sources]
        for source in sources:
            name = Path(source).stem if source.endswith(".toml") else source.replace(":", ".")
            if table.name and len(sources) > 1:
                name = f"{table.name}({name})"
            elif table.name:
                name = table.name
            yield Case(
                name=name,
                scenarios=self._scenarios_of(table),
                group=table.group or BASELINES,
                controller=source,
                against=table.against,
            )

    def _grid(self, table: CaseTable) -> Iterator[Case]:
        """The points of the grid of a table with an algorithm."""
        assert table.algorithm is not None
        axes = _axes(table)
        varied = [name for name, values in axes.items() if len(values) > 1]
        seeds = table.training_seeds or self.table.training_seeds
        for coordinates in product(*axes.values()):
            point = dict(zip(axes, coordinates, strict=True))
            label = " ".join(f"{name}={_text(point[name])}" for name in varied)
            yield Case(
                name=f"{table.name}({label})" if label else str(table.name),
                scenarios=self._scenarios_of(table),
                group=table.group or table.algorithm.rpartition(":")[2],
                algorithm=table.algorithm,
                samples=point.pop("samples"),
                start=point.pop("start"),
                nmpc=point.pop("nmpc"),
                # The other axes are those of the settings.
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
        # The point's coordinates with their brackets.
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
        scenarios_by_controller: dict[str, list[str]] = {}
        for name, scenario in self.scenarios.items():
            references = []
            # Without a model there is no NMPC.
            if scenario.controller.model is not None:
                references.append(NAIVE)
            if name in self.optima:
                references.append(self.optima[name])
            for reference in references:
                scenarios_by_controller.setdefault(reference, []).append(name)
        for case in self.cases:
            scenarios_by_controller.pop(case.controller or "", None)
        cases = []
        for controller, scenarios in scenarios_by_controller.items():
            cases.append(Case(controller, tuple(scenarios), BASELINES, controller=controller))
        return cases

    @property
    def all_cases(self) -> list[Case]:
        """References and cases, in the order of the tables."""
        return [*self.references, *self.cases]

    def named(self, controller: str) -> str:
        """A controller's name in the tables: the one that the study gives, else its own."""
        for case in self.cases:
            if case.controller == controller:
                return case.name
        return controller

    def noise(self, scenario: str) -> Noise:
        """Noise on which the cases of a scenario are compared."""
        table = self.table.evaluation
        count = self._value_for(scenario, table.seeds, "evaluation.seeds")
        steps = self._value_for(scenario, table.steps, "evaluation.steps")
        seeds = range(table.first_seed, table.first_seed + count)
        return Noise(tuple(seeds), steps, table.burn_in)

    def held_out(self, scenario: str) -> Noise:
        """Noise of the greedy evaluations during training."""
        table = self.table.curves
        count = self._value_for(scenario, table.seeds, "curves.seeds")
        steps = self._value_for(scenario, table.steps, "curves.steps")
        seeds = range(HELD_OUT, HELD_OUT + count)
        return Noise(tuple(seeds), steps)

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
        hours = self._value_for(scenario, self.table.operation.hours, "operation.hours")
        return self.samples_of(hours, scenario)

    def samples_of(self, hours: Sequence[float], scenario: str) -> tuple[int, ...]:
        """Hours of operation as samples, increasing."""
        sampling_time = self.scenarios[scenario].sampling_time
        # Unlike hours may be one sample.
        samples = set()
        for hour in hours:
            samples.add(max(1, round(3600.0 * hour / sampling_time)))
        longest = max(samples, default=0)
        if longest > MOST_SAMPLES:
            raise StudyError(
                f"operation.hours: {max(hours):g} h are {longest} samples of '{scenario}'; a run "
                f"has at most {MOST_SAMPLES}"
            )
        return tuple(sorted(samples))

    def _value_for(self, scenario: str, value: Choice | dict[str, Choice], field: str) -> Choice:
        """What a field of the study says for a scenario, itself or as the default."""
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
        for name in GIVEN_BY_STUDY:
            if name in case.training:
                raise ConfigurationError(f"training: {name} is given by the study itself")
        _check_known(case.training, OPTION_NAMES, "training", "option")
        marks = self.marks(scenario)
        if marks:
            _check_learns_in_operation(case)
        samples = marks[-1] if marks else case.samples
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
        between_points = max(1, samples // self.table.curves.points)
        # Rows of the log up to a greedy evaluation, evenly.
        n_rows = -(-between_points // MOST_BETWEEN_ROWS)
        log_every = max(1, between_points // n_rows)
        rows_between_checkpoints = max(1, round(BETWEEN_CHECKPOINTS / log_every))
        return {
            "log_every": log_every,
            "evaluate_every": log_every * n_rows,
            "checkpoint_every": log_every * rows_between_checkpoints,
            "evaluation_seeds": len(curves.seeds),
            "evaluation_steps": curves.steps,
        }


def _training_seeds(cases: Iterable[Case]) -> list[int]:
    """Seeds of the trainings of cases, each once, increasing."""
    seeds: set[int] = set()
    for case in cases:
        seeds.update(case.training_seeds)
    return sorted(seeds)


def _check_learns_in_operation(case: Case) -> None:
    """Refuse an algorithm that requires more of a plant than operation; raises what it is."""
    algorithm = str(case.algorithm)
    requires = load_algorithm(algorithm).requires
    if requires != "operation":
        raise ConfigurationError(
            f"case '{case.name}': '{algorithm}' requires a {requires}, and a study in operation "
            "has none"
        )


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
    # Every FMU is opened once: one that does not load must not stop a study half way.
    plants = {}
    for name, scenario in study.scenarios.items():
        with FmuPlant(scenario) as plant:
            plants[name] = {"scenario": scenario.hash, "fmu": plant.fmu_sha256}
    cases_on_scenarios = []
    for name, case in product(study.scenarios, study.all_cases):
        if name in case.scenarios:
            cases_on_scenarios.append(_CaseOnScenario.read(study, case, name))
    _check_case_names(study)
    runs = []
    # Controllers first, then seed after seed: stopped early, every case has fewer seeds.
    for seed in (None, *_training_seeds(study.cases)):
        for case_on_scenario in cases_on_scenarios:
            if seed in (case_on_scenario.case.training_seeds or (None,)):
                runs.append(case_on_scenario.run(seed))
    provenance = {
        "versions": versions(),
        "code_hash": code_hash(),
        "scenarios": plants,
        "study": study.name,
    }
    return StudyPlan(study, runs, provenance)


@dataclass(frozen=True)
class _CaseOnScenario:
    """A case on a scenario, with what its runs have in common.

    Attributes:
        study: the study.
        case: one of its cases.
        name: of the scenario.
        conditions: the scenario, and what workers must find.
        controller: the controller, or the start of a training.
    """

    study: Study
    case: Case
    name: str
    conditions: Conditions
    controller: ControllerSource

    @classmethod
    def read(cls, study: Study, case: Case, name: str) -> Self:
        """Read what a case needs; raises what a wrong case would raise in its run.

        Args:
            study: the study.
            case: one of its cases.
            name: of the scenario.
        """
        scenario = study.scenarios[name]
        controller = ControllerSource.read(study.located(case.controller or case.start))
        if case.algorithm is not None:
            training = study.training(case, name, seed=0, theta=controller.theta)
            training.make_run(scenario)
        elif ":" in (case.controller or ""):
            # Code of others may fail only when it is called.
            controller.build(scenario)
        conditions = Conditions.of_now(scenario, case.target, files=study.depends_on)
        return cls(study, case, name, conditions, controller)

    def run(self, seed: int | None) -> Run:
        """The run with a training seed; None of a controller."""
        study = self.study
        is_optimum = self.case.name == study.optima.get(self.name)
        marks = study.marks(self.name) if seed is not None or is_optimum else ()
        files_at_marks = {f"greedy-{mark}.csv": mark for mark in marks}
        noise = self._noise(seed, files_at_marks)
        facts: dict[str, Any] = {**self.conditions.facts, "functions": functions_for(noise)}
        theta = self.controller.theta
        if theta is not None:
            theta_file = Path(self.controller.name).name
            facts[theta_file] = hashlib.sha256(theta.encode()).hexdigest()
        training = None
        if seed is None:
            facts["controller"] = self.case.controller
        else:
            training = study.training(self.case, self.name, seed, theta)
            # As the file says, so that results depend on no folder.
            facts["training"] = training.facts(self.case.start)
        return Run(
            conditions=self.conditions,
            case=self.case.name,
            facts=facts,
            noise=noise,
            controller=self.controller if training is None else None,
            seed=seed,
            training=training,
            kept=self._kept(seed),
            marks=files_at_marks,
        )

    def _noise(self, seed: int | None, files_at_marks: Mapping[str, int]) -> dict[str, Noise]:
        """Noise of a run's evaluations by file.

        Args:
            seed: its training seed; None of a controller.
            files_at_marks: samples of operation after which its policy is evaluated, by file.
        """
        study = self.study
        noise = {EVALUATION: study.noise(self.name)}
        cases_here = [case for case in study.cases if self.name in case.scenarios]
        has_training = any(case.algorithm for case in cases_here)
        if seed is None and study.has_curves and has_training:
            # A level for the learning curves.
            noise[GREEDY] = study.held_out(self.name)
        for file in files_at_marks:
            noise[file] = study.noise_at_marks(self.name)
        for table in self._trajectories(seed):
            noise[table.file] = Noise((table.seed,), table.steps, whole=True)
        training_seeds = tuple(_training_seeds(cases_here))
        if seed is None and training_seeds:
            # The optimum, on the noise of the trainings.
            for mark in files_at_marks.values():
                noise[f"online-{mark}.csv"] = Noise(training_seeds, mark)
        return noise

    def _is_kept(self, seed: int | None) -> bool:
        """Whether a run is the one of its case whose files are kept."""
        first_training_seed = self.case.training_seeds[:1]
        return seed in (None, *first_training_seed)

    def _trajectories(self, seed: int | None) -> list[TrajectoryTable]:
        """The trajectories that a run is asked for."""
        if not self._is_kept(seed):
            return []
        wanted = []
        for table in self.study.table.trajectory:
            has_case = not table.cases or self.case.name in table.cases
            has_scenario = not table.scenarios or self.name in table.scenarios
            if has_case and has_scenario:
                wanted.append(table)
        return wanted

    def _kept(self, seed: int | None) -> dict[str, str]:
        """Where the study keeps a copy of a run's files, by file."""
        scenario = folder_name(self.name)
        case = folder_name(self.case.name)
        kept = {}
        for table in self._trajectories(seed):
            kept[table.file] = f"{TRAJECTORIES}/{table.name}/{scenario}/{case}.csv"
        if self._is_kept(seed) and self.case.name in self.study.table.logs:
            kept[LOG] = f"{LOGS}/{scenario}-{case}.csv"
            kept[PARAMETERS] = f"{THETA}/{scenario}-{case}.toml"
        return kept


def _check_case_names(study: Study) -> None:
    """Raise StudyError where a table names a case that is none."""
    names = [case.name for case in study.all_cases]
    trained = [case.name for case in study.cases if case.algorithm is not None]
    for table in study.table.trajectory:
        _check_known(table.cases or (), names, f"trajectory '{table.name}'", "case")
    _check_known(study.table.logs, trained, "logs", "case")
    if study.table.operation is not None:
        _check_known(study.table.operation.drawn, trained, "operation.drawn", "case")
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


def _axes(table: CaseTable) -> dict[str, list[Any]]:
    """Values of each field and setting that a case's grid runs over; raises StudyError."""
    axes = {}
    for name in GRID_FIELDS:
        value = getattr(table, name)
        axes[name] = value if isinstance(value, list) else [value]
    for name, value in table.settings.items():
        axes[name] = _values_of_setting(str(table.algorithm), name, value)
    for name, values in axes.items():
        if not values:
            raise StudyError(f"case '{table.name}': the grid of {name} is empty")
    return axes


def _values_of_setting(algorithm: str, setting: str, value: Any) -> list[Any]:
    """Values of a setting: a list is a grid, but for a setting that is a list itself."""
    if not isinstance(value, list):
        return [value]
    is_list_of_lists = bool(value) and all(isinstance(item, list) for item in value)
    field = load_algorithm(algorithm).Configuration.model_fields.get(setting)
    takes_list = field is not None and _is_sequence(field.annotation)
    if takes_list and not is_list_of_lists:
        return [value]
    return value


def _is_sequence(annotation: Any) -> bool:
    """Whether a field of this type takes a list, as one of its alternatives too."""
    if annotation in SEQUENCES or get_origin(annotation) in SEQUENCES:
        return True
    # `tuple[int, ...]` has an ellipsis, which is no type.
    alternatives = [part for part in get_args(annotation) if part is not Ellipsis]
    return any(_is_sequence(part) for part in alternatives)


def _text(value: Any) -> str:
    """A value of a grid as it stands in the name of its case."""
    if isinstance(value, str):
        return Path(value).stem
    return json.dumps(value).replace(" ", "")
