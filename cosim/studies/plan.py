"""`plan`: the runs of a study, and what each of them depends on."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Self

from controllers.factories import ControllerSource
from cosim.core.training_options import LOG, PARAMETERS
from cosim.evaluation import EVALUATION
from cosim.identity import code_hash, versions
from cosim.measurement import Noise
from cosim.plant import FmuPlant
from cosim.studies.definition import Case, Study, check_known, seeds_of_trainings
from cosim.studies.document import TrajectoryTable
from cosim.studies.run import GREEDY, Run, TrainingJob, folder_name, functions_for
from cosim.workers import Conditions

TRAJECTORIES = "trajectories"
"""Folder of the trajectories that a study keeps of its runs."""
LOGS = "logs"
"""Folder of the logs that it keeps."""
THETA = "parameters"
"""Folder of the θ files that it keeps."""


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
            plants[name] = {
                "scenario": scenario.hash,
                "fmu": plant.fmu_sha256,
            }
    cases_on_scenarios = []
    for name, case in product(study.scenarios, study.all_cases):
        if name in case.scenarios:
            cases_on_scenarios.append(_CaseOnScenario.read(study, case, name))
    _check_case_names(study)
    runs = []
    # Controllers first, then seed after seed: stopped early, every case has fewer seeds.
    for seed in (None, *seeds_of_trainings(study.cases)):
        for case_on_scenario in cases_on_scenarios:
            if seed in case_on_scenario.seeds:
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
        # What is evaluated as it is, or where θ starts.
        source = case.controller or case.start
        controller = ControllerSource.read(study.located(source))
        if case.algorithm is not None:
            # Settings are validated where a run is made; any seed will do.
            training = study.training(case, name, seed=0, theta=controller.theta)
            training.make_run(scenario)
        elif ":" in (case.controller or ""):
            # Code of others may fail only when it is called.
            controller.build(scenario)
        conditions = Conditions.of_now(scenario, case.target, files=study.depends_on)
        return cls(study, case, name, conditions, controller)

    @property
    def seeds(self) -> tuple[int | None, ...]:
        """Training seeds of its runs; None for the one run of a controller."""
        return self.case.training_seeds or (None,)

    def run(self, seed: int | None) -> Run:
        """The run with a training seed; None of a controller."""
        files_at_marks = self._files_at_marks(seed)
        noise = self._noise(seed, files_at_marks)
        training = None
        if seed is not None:
            theta = self.controller.theta
            training = self.study.training(self.case, self.name, seed, theta)
        facts = {
            **self.conditions.facts,
            "functions": functions_for(noise),
            **self._facts(training),
        }
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

    def _facts(self, training: TrainingJob | None) -> dict[str, Any]:
        """Inputs of a run's results beside its conditions."""
        facts: dict[str, Any] = {}
        theta = self.controller.theta
        if theta is not None:
            # By content: an edited θ file is another controller.
            theta_file = Path(self.controller.name).name
            digest = hashlib.sha256(theta.encode())
            facts[theta_file] = digest.hexdigest()
        if training is None:
            facts["controller"] = self.case.controller
        else:
            # As the file says, so that results depend on no folder.
            facts["training"] = training.facts(self.case.start)
        return facts

    def _files_at_marks(self, seed: int | None) -> dict[str, int]:
        """Samples of operation after which a run's policy is evaluated, by file of the result."""
        is_optimum = self.case.name == self.study.optima.get(self.name)
        # Regrets at a mark are taken against the optimum; no other controller is needed there.
        if seed is None and not is_optimum:
            return {}
        marks = self.study.marks(self.name)
        return {f"greedy-{mark}.csv": mark for mark in marks}

    def _noise(
        self,
        seed: int | None,
        files_at_marks: Mapping[str, int],
    ) -> dict[str, Noise]:
        """Noise of a run's evaluations by file.

        Args:
            seed: its training seed; None of a controller.
            files_at_marks: samples of operation after which its policy is evaluated, by file.
        """
        study = self.study
        noise = {EVALUATION: study.noise(self.name)}
        cases_here = [case for case in study.cases if self.name in case.scenarios]
        has_training = any(case.algorithm for case in cases_here)
        if seed is None and study.draws_curves(self.name) and has_training:
            # A level for the learning curves.
            noise[GREEDY] = study.held_out(self.name)
        for file in files_at_marks:
            noise[file] = study.noise_at_marks(self.name)
        for table in self._trajectories(seed):
            noise[table.file] = Noise(
                seeds=(table.seed,),
                steps=table.steps,
                whole=True,
            )
        training_seeds = tuple(seeds_of_trainings(cases_here))
        if seed is None and training_seeds:
            # The optimum, on the noise of the trainings.
            for mark in files_at_marks.values():
                noise[f"online-{mark}.csv"] = Noise(training_seeds, mark)
        return noise

    def _is_kept(self, seed: int | None) -> bool:
        """Whether a run is the one of its case whose files are kept."""
        return seed == self.seeds[0]

    def _trajectories(self, seed: int | None) -> list[TrajectoryTable]:
        """The trajectories that a run is asked for."""
        if not self._is_kept(seed):
            return []
        wanted = []
        for table in self.study.table.trajectory:
            # A table that names none is of all.
            has_case = not table.cases or self.case.name in table.cases
            has_scenario = not table.scenarios or self.name in table.scenarios
            if has_case and has_scenario:
                wanted.append(table)
        return wanted

    def _kept(self, seed: int | None) -> dict[str, str]:
        """Places of the study's copies of a run's files, by file."""
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
    names = []
    trained = []
    for case in study.all_cases:
        names.append(case.name)
        if case.algorithm is not None:
            trained.append(case.name)
    for table in study.table.trajectory:
        check_known(table.cases or (), names, f"trajectory '{table.name}'", "case")
    check_known(study.table.logs, trained, "logs", "case")
    if study.table.operation is not None:
        check_known(study.table.operation.drawn, trained, "operation.drawn", "case")
    for case in study.cases:
        study.counterpart(case)
