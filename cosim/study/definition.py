"""What a study is made of: scenarios, cases and sizes, loaded and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from cosim.errors import StudyError
from cosim.lookup import import_from
from cosim.scenario import Scenario, resolved
from cosim.study.cases import BASELINES, Case, expand
from cosim.study.document import DEFAULT, PerScenario, StudyTable, read, validate
from cosim.study.protocols import Trainer, Training, registered_trainer
from cosim.validation import suggestion

NAIVE = "naive"
HELD_OUT = 1_000_000
"""First of the held-out seeds that greedy evaluations during training use."""
ROW = 500
"""Samples of a training between two rows of its log, at most."""
CHECKPOINT = 5000
"""Samples of a training between two checkpoints, about."""


@dataclass(frozen=True)
class Sizes:
    """How much noise a scenario's figures are measured on.

    Evaluation: the noise `seeds`, `steps` samples on each. Learning curves: `curve_seeds` held-out
    runs of `curve_steps` samples.
    """

    seeds: tuple[int, ...]
    steps: int
    curve_seeds: int
    curve_steps: int


class Definition:
    """Cases × scenarios × training seeds, and the noise that they are compared on.

    `load` reads a study file, `from_dict` takes the same document. `folder` is
    where its relative paths start and where its `module:Class` names are looked up, too. `trainer`
    is who trains; without one, the one that is registered in the entry-point group
    `cosim.trainers`. Raises StudyError, and what the trainer raises.
    """

    def __init__(self, table: StudyTable, folder: Path, trainer: Trainer | None = None) -> None:
        self.table = table
        self.folder = folder.resolve()
        import_from(self.folder)
        self.trainer = registered_trainer() if trainer is None else trainer

    @classmethod
    def load(cls, path: str | Path, *, trainer: Trainer | None = None) -> Self:
        """Read a study file; raises StudyError."""
        return cls(read(path), Path(path).resolve().parent, trainer)

    @classmethod
    def from_dict(
        cls,
        document: Mapping[str, Any],
        folder: str | Path = ".",
        *,
        trainer: Trainer | None = None,
    ) -> Self:
        """Validate a document, structured like the TOML file; raises StudyError."""
        return cls(validate(dict(document), "study"), Path(folder), trainer)

    @property
    def name(self) -> str:
        """The study's name."""
        return self.table.name

    @cached_property
    def scenarios(self) -> dict[str, Scenario]:
        """Scenarios by name, in the study's order; raises StudyError and ScenarioError."""
        own = {}
        for document in self.table.scenario:
            where = f"study '{self.name}', [[scenario]]"
            scenario = Scenario.from_dict(resolved(document, where, self.folder), where)
            own[scenario.name] = scenario
        found: dict[str, Scenario] = {}
        for source in self.table.scenarios:
            path = self.folder / source
            is_file = source.endswith(".toml")
            scenario = own.get(source) or Scenario.load(path if is_file else source)
            if scenario.name in found:
                raise StudyError(
                    f"two scenarios are called '{scenario.name}'; their files' name must differ"
                )
            found[scenario.name] = scenario
        return found

    @cached_property
    def cases(self) -> list[Case]:
        """Every case, grids written out; raises StudyError and what the trainer raises."""
        names = tuple(self.scenarios)
        cases = expand(self.table.case, names, self.table.training_seeds, self.folder, self.trainer)
        self._check_seeds(cases)
        return cases

    @cached_property
    def optima(self) -> dict[str, str]:
        """Names of the cases whose J is J*, by scenario; scenarios without one are not there."""
        found: dict[str, str] = {}
        for name, scenario in self.scenarios.items():
            if (optimum := self.trainer.optimum(scenario)) is not None:
                found[name] = self._named(optimum)
        return found

    @cached_property
    def references(self) -> list[Case]:
        """Controllers that relative figures need and that the study does not name: naive, J*."""
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

    def _named(self, controller: str) -> str:
        """A case's name for a controller: the study's, if it has one for it."""
        return next((c.name for c in self.cases if c.controller == controller), controller)

    def relative(self, path: str) -> str:
        """A parameters file's path as the study names it: results depend on no checkout's place."""
        if not path.endswith(".toml") or self.folder not in Path(path).parents:
            return path
        return Path(path).relative_to(self.folder).as_posix()

    @cached_property
    def naive(self) -> str:
        """Name of the case that the gap closed starts from."""
        return self._named(NAIVE)

    def sizes(self, scenario: str) -> Sizes:
        """Noise seeds and samples of a scenario."""
        evaluation, curves = self.table.evaluation, self.table.curves
        first = evaluation.first_seed
        count = self._of(evaluation.seeds, scenario, "evaluation.seeds")
        return Sizes(
            tuple(range(first, first + count)),
            self._of(evaluation.steps, scenario, "evaluation.steps"),
            self._of(curves.seeds, scenario, "curves.seeds"),
            self._of(curves.steps, scenario, "curves.steps"),
        )

    def _of(self, value: PerScenario, scenario: str, field: str) -> int:
        if isinstance(value, int):
            return value
        names = [*self.scenarios, DEFAULT]
        if unknown := [name for name in value if name not in names]:
            raise StudyError(
                f"{field}: '{unknown[0]}' is no scenario of the study"
                f"{suggestion(unknown[0], names)}; there are {', '.join(names)}"
            )
        number = value.get(scenario, value.get(DEFAULT))
        if number is None:
            raise StudyError(f"{field}: has no number for '{scenario}', and no '{DEFAULT}'")
        return number

    def training(self, case: Case, scenario: str, seed: int) -> Training:
        """The training of a case on a scenario with one seed."""
        assert case.algorithm is not None
        sizes = self.sizes(scenario)
        between = max(1, case.samples // self.table.curves.points)
        rows = -(-between // ROW)
        log_every = max(1, between // rows)
        if (online := self.table.online) is not None:
            log_every, rows = online.block, max(1, between // online.block)
        options = {
            "log_every": log_every,
            "evaluate_every": rows * log_every,
            "checkpoint_every": log_every * max(1, round(CHECKPOINT / log_every)),
            "evaluation_seeds": sizes.curve_seeds,
            "evaluation_steps": sizes.curve_steps,
            **case.training,
        }
        return Training(
            algorithm=case.algorithm,
            scenario=self.scenarios[scenario],
            samples=case.samples,
            seed=seed,
            settings=case.settings,
            start=case.start,
            nmpc=case.nmpc,
            log_every=options.pop("log_every"),
            evaluate_every=options.pop("evaluate_every"),
            checkpoint_every=options.pop("checkpoint_every"),
            evaluation_seeds=options.pop("evaluation_seeds"),
            evaluation_steps=options.pop("evaluation_steps"),
            options=options,
        )

    def _check_seeds(self, cases: list[Case]) -> None:
        """Raise StudyError where noise of the evaluation is met in training."""
        for scenario in self.scenarios:
            sizes = self.sizes(scenario)
            met = {seed for case in cases for seed in case.training_seeds}
            held_out = range(HELD_OUT, HELD_OUT + sizes.curve_seeds)
            for seeds, what in ((met, "a training seed"), (held_out, "a seed of the curves")):
                if common := sorted(set(seeds) & set(sizes.seeds)):
                    raise StudyError(
                        f"evaluation: noise seed {common[0]} is {what} too; choose another "
                        "first_seed"
                    )
