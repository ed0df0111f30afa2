"""What a study measured: its runs, typed, from the runner or read back from the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.errors import StudyError
from cosim.files import read_json
from cosim.statistics import Estimate, gap_closed, regret
from cosim.study.records import CaseResult, RunResult
from cosim.study.tables import read_runs

Array = NDArray[np.float64]
ABOUT = "study.json"
SCHEMA = 1


@dataclass(frozen=True)
class StudyResults:
    """What a study measured, in `folder`.

    `about` says what the study is and what it was made with; `runs` are those that are finished.
    """

    folder: Path
    about: Mapping[str, Any]
    runs: Sequence[RunResult]

    @classmethod
    def load(cls, folder: str | Path) -> StudyResults:
        """Read a study's folder, or a stored one; raises StudyError."""
        path = Path(folder) / ABOUT
        if not path.exists():
            raise StudyError(
                f"'{folder}' holds no study ({ABOUT}); give the --out of a cosim study run"
            )
        about = read_json(path, f"'{path}'", StudyError)
        if about.get("schema") != SCHEMA:
            raise StudyError(f"'{path}' has schema {about.get('schema')!r}; this is {SCHEMA}")
        return cls(Path(folder), about, read_runs(Path(folder)))

    @property
    def name(self) -> str:
        """The study's name."""
        return str(self.about["name"])

    @cached_property
    def scenarios(self) -> list[str]:
        """Scenarios, in the study's order."""
        return list(self.about["scenarios"])

    @cached_property
    def cases(self) -> dict[str, CaseResult]:
        """Cases by name, in the study's order."""
        return {case["name"]: CaseResult(**case) for case in self.about["cases"]}

    @cached_property
    def _by_case(self) -> dict[tuple[str, str], list[RunResult]]:
        found: dict[tuple[str, str], list[RunResult]] = {}
        for run in self.runs:
            found.setdefault((run.scenario, run.case), []).append(run)
        return found

    def of(self, case: str, scenario: str) -> list[RunResult]:
        """The finished runs of a case on a scenario, by training seed; [] if there are none."""
        return self._by_case.get((scenario, case), [])

    def _reference(self, kind: str, scenario: str) -> RunResult | None:
        name = self.about[kind].get(scenario)
        found = [] if name is None else self.of(name, scenario)
        return found[0] if found else None

    def optimum(self, scenario: str) -> RunResult | None:
        """The run that gives J* on a scenario, None if there is none."""
        return self._reference("optimum", scenario)

    def naive(self, scenario: str) -> RunResult | None:
        """The run that the gap closed starts from, None if there is none."""
        return self._reference("naive", scenario)

    def regret(self, *runs: RunResult) -> Estimate:
        """(J − J*)/|J*| of a run, or of the mean of several, paired over the noise seeds.

        NaN where the scenario has no known optimum.
        """
        optimum = self.optimum(runs[0].scenario)
        if optimum is None:
            return Estimate(float("nan"))
        cost = np.mean([_paired(run, optimum) for run in runs], axis=0)
        return regret(cost, optimum.indicators["J"])

    @cached_property
    def regrets(self) -> dict[tuple[str, str, int | None], float]:
        """Regret of every run by scenario, case and training seed; infinite where J is no number.

        Scenarios whose J* is not known are not there.
        """
        return {
            run.key: self.regret(run).value if np.isfinite(run.J) else float("inf")
            for run in self.runs
            if self.optimum(run.scenario) is not None
        }

    def gap_closed(self, *runs: RunResult) -> Estimate:
        """(J_naive − J)/(J_naive − J*), likewise."""
        optimum, naive = self.optimum(runs[0].scenario), self.naive(runs[0].scenario)
        if optimum is None or naive is None:
            return Estimate(float("nan"))
        cost = np.mean([_paired(run, optimum) for run in runs], axis=0)
        return gap_closed(cost, _paired(naive, optimum), optimum.indicators["J"])


def _paired(run: RunResult, other: RunResult) -> Array:
    """J (S,) of a run; raises StudyError where it met other noise than the other one."""
    if run.seeds != other.seeds or run.steps != other.steps:
        raise StudyError(
            f"{run.case} and {other.case} on {run.scenario} were evaluated on different noise; run "
            "the study again"
        )
    return run.indicators["J"]
