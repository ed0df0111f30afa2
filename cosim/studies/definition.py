"""`Study`: the cases to compare, the scenarios and the noise, as a study file defines them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self, TypeVar

from controllers.factories import stored_optimum
from cosim.core.errors import StudyError
from cosim.core.modules import import_from
from cosim.core.scenario import Scenario, resolved
from cosim.core.training_options import HELD_OUT, OPTION_NAMES, SLOW_LOG_EVERY, TrainingOptions
from cosim.core.validation import instead, validated
from cosim.evaluation import NAIVE
from cosim.measurement import Noise
from cosim.plant.fmi import steps_are_fast
from cosim.studies.document import DEFAULT, CaseTable, SeedsTable, StudyTable, read
from cosim.studies.grid import GridPoint, grid_points
from cosim.studies.run import TrainingJob
from learning.algorithm import load_algorithm
from learning.errors import ConfigurationError

BASELINES = "baselines"
"""Group of the cases that figures show as lines to compare with."""
LEAST_BETWEEN_POINTS = 50
"""Samples between two greedy evaluations, at least, where a study does not say how many they are.

Each of them takes some thousand samples of the plant.
"""
MOST_BETWEEN_ROWS = 500
"""Samples between two rows of a log, at most."""
BETWEEN_CHECKPOINTS = 5000
"""Samples between two checkpoints, about."""
MOST_SAMPLES = 100_000_000
"""Samples of the longest run."""
GIVEN_BY_STUDY = ("controller", "seed", "start")
"""Options of a training that a case's table `training` may not say."""
Choice = TypeVar("Choice")


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

    def __init__(
        self,
        table: StudyTable,
        folder: Path,
        file: str | None = None,
    ) -> None:
        self.table = table
        self.file = file
        # Users' modules are found from here, whatever the working directory is then.
        self.folder = folder.resolve()
        import_from(self.folder)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a study file; raises StudyError."""
        folder = Path(path).resolve().parent
        return cls(read(path), folder, str(path))

    @classmethod
    def from_dict(cls, document: Mapping[str, Any], folder: str | Path = ".") -> Self:
        """Validate a document that is structured like the TOML file.

        Args:
            document: the study.
            folder: from which relative paths and users' modules are looked up.

        Raises:
            StudyError: the document is no study.
        """
        table = validated(StudyTable, dict(document), "study", StudyError)
        return cls(table, Path(folder))

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
            # The names of a run's other facts have no such beginning.
            paths[f"file {name}"] = str(path)
        return paths

    @cached_property
    def scenarios(self) -> dict[str, Scenario]:
        """Scenarios by name, in the study's order."""
        written_here = self._written_scenarios()
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

    def _written_scenarios(self) -> dict[str, Scenario]:
        """Scenarios of the study file's own tables, by name."""
        scenarios = {}
        where = f"study '{self.name}', [[scenario]]"
        for document in self.table.scenario:
            # What it extends is looked up from the study's folder, as all of its paths.
            whole = resolved(document, where, self.folder)
            scenario = Scenario.from_dict(whole, where)
            scenarios[scenario.name] = scenario
        return scenarios

    @cached_property
    def cases(self) -> list[Case]:
        """Every case, grids written out."""
        cases: list[Case] = []
        for table in self.table.case:
            if table.algorithm is None:
                cases += self._controllers(table)
            else:
                cases += self._grid(table)
        names: set[str] = set()
        for case in cases:
            # Tables and folders know a case by its name.
            if case.name in names:
                raise StudyError(f"two cases are called '{case.name}'; give each another name")
            names.add(case.name)
        self._check_seeds(seeds_of_trainings(cases))
        return cases

    def _check_seeds(self, training_seeds: Iterable[int]) -> None:
        """Refuse noise that is evaluated on and met elsewhere, too; raises StudyError."""
        # Evaluated on noise that it was trained or chosen on, θ would look better than it is.
        for scenario in self.scenarios:
            met_as = dict.fromkeys(training_seeds, "a training seed")
            if self.has_curves:
                seeds_of_curves = self.held_out(scenario).seeds
                met_as |= dict.fromkeys(seeds_of_curves, "a seed of the curves")
            for seed in self.noise(scenario).seeds:
                if seed in met_as:
                    raise StudyError(
                        f"evaluation: noise seed {seed} is {met_as[seed]} too; choose another "
                        "first_seed"
                    )

    def _scenarios_of(self, table: CaseTable) -> tuple[str, ...]:
        """Scenarios that the cases of a table run on; raises StudyError."""
        if table.scenarios is None:
            return tuple(self.scenarios)
        check_known(table.scenarios, self.scenarios, f"case '{table.name}'", "scenario")
        return tuple(table.scenarios)

    def _controllers(self, table: CaseTable) -> Iterator[Case]:
        """The cases of a table with one controller or several."""
        sources = table.controller or ""
        if not isinstance(sources, list):
            sources = [sources]
        for source in sources:
            name = _name_of_controller(source)
            if table.name and len(sources) > 1:
                # As in a grid: the table's name, and which of its points it is.
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
        for point in grid_points(table):
            yield self._trained_case(table, point)

    def _trained_case(self, table: CaseTable, point: GridPoint) -> Case:
        """The case of a point of a table's grid."""
        assert table.algorithm is not None
        name = f"{table.name}({point.label})" if point.label else str(table.name)
        # Of `module:Class` the class is the rule's name.
        algorithm_name = table.algorithm.rpartition(":")[2]
        seeds = table.training_seeds or self.table.training_seeds
        return Case(
            name=name,
            scenarios=self._scenarios_of(table),
            group=table.group or algorithm_name,
            algorithm=table.algorithm,
            **point.fields,
            settings=point.settings,
            training=dict(table.training),
            training_seeds=_seed_numbers(seeds),
            against=table.against,
        )

    def located(self, source: str) -> str:
        """A parameters file's path, given from the study's folder; other names as they are."""
        if not source.endswith(".toml"):
            return source
        return str(self.folder / source)

    def counterpart(self, case: Case) -> str | None:
        """Name of the case that a case's paired difference is taken from; raises StudyError.

        In a grid it is the counterpart's point of the same label, where there is one.
        """
        if case.against is None:
            return None
        names = [other.name for other in self.all_cases]
        # The point's coordinates with their brackets; empty outside of a grid.
        _, bracket, coordinates = case.name.partition("(")
        same_point = f"{case.against}{bracket}{coordinates}"
        for name in (case.against, same_point):
            # A case has no difference from itself.
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
            references: list[str] = []
            # Without a model there is no NMPC.
            if scenario.controller.model is not None:
                references.append(NAIVE)
            if name in self.optima:
                references.append(self.optima[name])
            for reference in references:
                scenarios_by_controller.setdefault(reference, []).append(name)
        # A reference that is a case of the study is not run twice.
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

    def is_fast(self, scenario: str) -> bool:
        """Whether a scenario's plant is known to be fast; a step of another's FMU may take long."""
        return steps_are_fast(self.scenarios[scenario].plant.fmu)

    def draws_curves(self, scenario: str) -> bool:
        """Whether all trainings on a scenario have the greedy evaluations of `[curves]`.

        On a plant that may be slow they have them only where the study asks for them.
        """
        return self.has_curves and (
            "curves" in self.table.model_fields_set or self.is_fast(scenario)
        )

    def noise_at_marks(self, scenario: str) -> Noise:
        """Noise on which θ is evaluated at the times of operation."""
        evaluation = self.noise(scenario)
        if not self.has_curves:
            return evaluation
        # What counts begins as late as in the evaluation, or the two could not be compared.
        return self.held_out(scenario)._replace(burn_in=evaluation.burn_in)

    def marks(self, scenario: str) -> tuple[int, ...]:
        """Samples of operation at which a scenario's runs are evaluated; else empty."""
        if self.table.operation is None:
            return ()
        hours = self._value_for(scenario, self.table.operation.hours, "operation.hours")
        return self.samples_of(hours, scenario)

    def samples_of(self, hours: Sequence[float], scenario: str) -> tuple[int, ...]:
        """Hours of operation as samples, increasing.

        Args:
            hours: times of operation.
            scenario: name of the scenario, whose sampling time counts.

        Raises:
            StudyError: a run would be too long.
        """
        sampling_time = self.scenarios[scenario].sampling_time
        # Unlike hours may be one sample.
        samples = set()
        for hour in hours:
            nearest = round(3600.0 * hour / sampling_time)
            # Before its first sample a run has learned nothing.
            samples.add(max(1, nearest))
        longest = max(samples, default=0)
        if longest > MOST_SAMPLES:
            raise StudyError(
                f"operation.hours: {max(hours):g} h are {longest} samples of '{scenario}'; a run "
                f"has at most {MOST_SAMPLES}"
            )
        return tuple(sorted(samples))

    def _value_for(
        self,
        scenario: str,
        value: Choice | dict[str, Choice],
        field: str,
    ) -> Choice:
        """Value of a field of the study for a scenario, or its default."""
        if not isinstance(value, dict):
            return value
        check_known(value, [*self.scenarios, DEFAULT], field, "scenario")
        number = value.get(scenario, value.get(DEFAULT))
        if number is None:
            raise StudyError(f"{field}: has no number for '{scenario}', and no '{DEFAULT}'")
        return number

    def training(
        self,
        case: Case,
        scenario: str,
        seed: int,
        theta: str | None,
    ) -> TrainingJob:
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
        # An option that the study overwrites would have no effect, and nobody would be told.
        for name in GIVEN_BY_STUDY:
            if name in case.training:
                raise ConfigurationError(f"training: {name} is given by the study itself")
        check_known(case.training, OPTION_NAMES, "training", "option")
        marks = self.marks(scenario)
        if marks:
            _check_learns_in_operation(case)
        # In operation the last mark is the length of every run.
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
        # Of a short training nobody has asked for so many points.
        if "points" not in self.table.curves.model_fields_set:
            between_points = max(between_points, min(samples, LEAST_BETWEEN_POINTS))
        # Rows of the log up to a greedy evaluation, evenly.
        n_rows = -(-between_points // MOST_BETWEEN_ROWS)
        log_every = max(1, between_points // n_rows)
        between_checkpoints = BETWEEN_CHECKPOINTS
        # Each step of another's FMU may take its time: what a stop loses is little.
        if not self.is_fast(scenario):
            log_every = min(log_every, SLOW_LOG_EVERY)
            n_rows = max(1, between_points // log_every)
            between_checkpoints = SLOW_LOG_EVERY
        # A checkpoint is taken at a row of the log.
        rows_between_checkpoints = max(1, round(between_checkpoints / log_every))
        # Held-out runs are then a share of the training's samples, unless the study says more.
        if self.has_curves and not self.draws_curves(scenario):
            return {
                "log_every": log_every,
                "evaluate_every": log_every * max(1, samples // log_every),
                "checkpoint_every": log_every * rows_between_checkpoints,
            }
        return {
            "log_every": log_every,
            "evaluate_every": log_every * n_rows,
            "checkpoint_every": log_every * rows_between_checkpoints,
            "evaluation_seeds": len(curves.seeds),
            "evaluation_steps": curves.steps,
        }


def _name_of_controller(source: str) -> str:
    """A controller's own name in tables: a file's without folder and suffix, `module.factory`."""
    if source.endswith(".toml"):
        return Path(source).stem
    return source.replace(":", ".")


def _seed_numbers(seeds: SeedsTable) -> tuple[int, ...]:
    """The training seeds of a table."""
    return tuple(range(seeds.first, seeds.first + seeds.count))


def seeds_of_trainings(cases: Iterable[Case]) -> list[int]:
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


def check_known(words: Iterable[str], known: Iterable[str], where: str, kind: str) -> None:
    """Raise StudyError on a word that is not known.

    Args:
        words: what the study file gives.
        known: what it may give.
        where: field of the study file.
        kind: what a word names.
    """
    for word in words:
        if word not in known:
            suggestion = instead(word, known)
            raise StudyError(f"{where}: there is no {kind} '{word}'{suggestion}")
