"""Controllers × seeds, cut into work units, run in parallel and put together again."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cosim.errors import EvaluationError
from cosim.evaluation.parallel import run_all
from cosim.evaluation.provenance import code_hash, controller_hash, parameters_hash, versions
from cosim.evaluation.reuse import release
from cosim.evaluation.runs import Runs
from cosim.evaluation.store import Store, unit_key
from cosim.evaluation.table import Evaluation
from cosim.evaluation.unit import BLOCK, SETTLING, Factory, RunUnit, UnitResult, run
from cosim.kpis import comes_to_rest
from cosim.lookup import build_controller
from cosim.plant import FmuPlant
from cosim.scenario import Scenario

NAIVE, OPTIMUM = "naive", "optimal"


def evaluate(
    scenario: Scenario | str | Path,
    controllers: Mapping[str, Factory | str] | Sequence[str],
    seeds: int | Sequence[int],
    steps: int,
    *,
    optimum: Factory | None = None,
    folder: str | Path | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
    command: str = "cosim.evaluate",
) -> Evaluation:
    """Run every controller on every seed and return the table; the bytes depend on no worker.

    A seed means the same disturbances to all controllers (common random numbers), so differences
    are to be taken seed by seed.

    Raises EvaluationError on a malformed request or failed workers, and whatever building or
    running a controller raises.

    Parameters
    ----------
    controllers : by name a factory(scenario) -> Controller, importable where the workers run, or
        what `cosim.lookup.build_controller` takes; or only such texts, a file by its stem. The
        one named `naive`, else the first, is the gains' reference; `optimal` gives J*.
    seeds : the seeds, or their number S for 0 … S−1.
    steps : samples per run.
    optimum : gives J* on the same seeds, without rows of its own, where no controller is named
        `optimal`.
    folder : where finished work units are kept and found again; None keeps none.
    jobs : worker processes; 1 works in this process.
    scheduler : address of a Dask scheduler, used in place of `jobs`.
    progress : called with the number of units done, of controllers × seeds in all, one more for
        each controller whose settling is measured, and `seeds` more for an `optimum`.
    command : the text of the column `command`.
    """
    scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
    numbers = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    factories = _factories(controllers)
    _check(factories, numbers, steps)
    plan = _Plan(scenario, factories, numbers, steps, optimum)
    store = Store(None if folder is None else Path(folder))
    for key, result in store.load(plan.keys):
        plan.take(key, result)
    report = progress or (lambda _: None)
    report(plan.known)

    def done(key: str, result: UnitResult) -> None:
        store.save(key, result)
        plan.take(key, result)
        report(plan.known)

    try:
        run_all(run, plan.missing(), done, jobs=jobs, scheduler=scheduler)
    finally:
        release()
    return plan.assemble(command)


def _factories(controllers: Mapping[str, Factory | str] | Sequence[str]) -> dict[str, Factory]:
    """Factories by name; raises EvaluationError where two controllers have one name."""
    if not isinstance(controllers, Mapping):
        named = {Path(text).stem if text.endswith(".toml") else text: text for text in controllers}
        if isinstance(controllers, str) or len(named) < len(controllers):
            raise EvaluationError(
                "controllers must be a list of different names, or a mapping that gives each one"
            )
        controllers = named
    return {
        name: partial(build_controller, item) if isinstance(item, str) else item
        for name, item in controllers.items()
    }


def _check(controllers: Mapping[str, Factory], seeds: Sequence[int], steps: int) -> None:
    if not controllers:
        raise EvaluationError("no controller to evaluate")
    if not seeds:
        raise EvaluationError("no seed to evaluate on; give at least one")
    if len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise EvaluationError("seeds must be distinct and not negative")
    if max(seeds) >= 1 << 64:
        raise EvaluationError(f"seeds must be below 2⁶⁴; the last one is {max(seeds)}")
    if steps < 1:
        raise EvaluationError(f"steps must be at least 1, not {steps}")


class _Plan:
    """What is wanted and what is known of it. Building each controller here finds every mistake."""

    def __init__(
        self,
        scenario: Scenario,
        controllers: Mapping[str, Factory],
        seeds: Sequence[int],
        steps: int,
        optimum: Factory | None,
    ) -> None:
        self._names, self._seeds = list(controllers), list(seeds)
        every = dict(controllers)
        if optimum is not None:
            every.setdefault(OPTIMUM, optimum)
        self._optimum = OPTIMUM if OPTIMUM in every else None
        with FmuPlant(scenario) as plant:
            fmu = plant.fmu_sha256
        code, self._rests = code_hash(), comes_to_rest(scenario)
        self._facts: dict[str, Any] = {
            "scenario": scenario.name,
            "steps": steps,
            "version": versions().partition("rti-cosim ")[2].partition(";")[0],
            "versions": versions(),
            "code_hash": code,
            "scenario_hash": scenario.hash,
            "fmu_sha256": fmu,
        }
        self._parameters: dict[str, str] = {}
        self._units: dict[str, RunUnit] = {}
        self._runs: dict[str, Runs] = {}
        self._settling = {} if self._rests else dict.fromkeys(self._names, float("nan"))
        self.keys: dict[str, str] = {}
        """Names of the controllers by what their units are stored under."""
        self.known = 0
        """Number of runs that are known."""
        session = secrets.token_hex(8)
        for name, factory in every.items():
            controller = factory(scenario)
            self._parameters[name] = parameters_hash(controller)
            key = unit_key(
                self._facts
                | {
                    "scenario": None,
                    "controller": name,
                    "controller_hash": controller_hash(controller),
                    "parameters_hash": self._parameters[name],
                }
            )
            self.keys[key] = name
            self._runs[name] = Runs(self._seeds)
            self._units[name] = RunUnit(
                session, name, factory, scenario, SETTLING, steps, code, fmu
            )

    def missing(self) -> Iterator[tuple[str, RunUnit]]:
        """Units of what is not known, each under its controller's key, made when asked for."""
        for key, name in self.keys.items():
            unit = self._units[name]
            if name in self._names and name not in self._settling:
                yield key, unit
            seeds, size = self._runs[name].missing(), -(-BLOCK // unit.steps)
            for first in range(0, len(seeds), size):
                yield key, replace(unit, seeds=tuple(seeds[first : first + size]))

    def take(self, key: str, result: UnitResult) -> None:
        """Take up what a unit gave, now or before."""
        name = self.keys[key]
        if result.seeds != SETTLING:
            self.known += self._runs[name].add(result)
        elif name not in self._settling:
            (self._settling[name],) = result.indicators["settling_time"]
            self.known += 1

    def assemble(self, command: str) -> Evaluation:
        names = self._names
        return Evaluation(
            controllers=names,
            seeds=self._seeds,
            results=self._runs,
            settling={name: self._settling[name] for name in names},
            parameters={name: self._parameters[name] for name in names},
            facts=self._facts | {"command": command},
            reference=NAIVE if NAIVE in names else names[0],
            optimum=self._optimum,
            naive=NAIVE if NAIVE in names else None,
        )
