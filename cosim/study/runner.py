"""Runs a study: gives out units, stores what they give, and says how far it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from cosim.evaluation.parallel import run_all
from cosim.evaluation.reuse import release
from cosim.study.plan import BLOCK, Plan, Run
from cosim.study.protocols import Progress
from cosim.study.store import EVALUATION, RunStore
from cosim.study.units import (
    Accompanied,
    Accompany,
    Advance,
    Evaluate,
    Evaluated,
    Failure,
    Learnt,
    Outcome,
    Place,
    Trace,
    Traced,
    Unit,
    perform,
)

SLICE = 5.0
"""Seconds of a training after which a worker hands over its next checkpoint."""


@dataclass(frozen=True)
class State:
    """How far a study is: plant samples done, runs done and in all, and how many failed."""

    samples: int
    runs: int
    all_runs: int
    failed: int


Report = Callable[[State, str], None]
"""Gets the state and a line for what just happened; the line is empty for mere progress."""


class Runner:
    """One go at a study. `out` holds what was finished before; see `RunStore`."""

    def __init__(self, plan: Plan, out: Path, report: Report) -> None:
        definition = plan.definition
        self._plan, self._report = plan, report
        folders = (str(definition.folder), str(Path.cwd()))
        self._place = Place(
            definition.trainer,
            tuple(dict.fromkeys(folders)),
            plan.provenance["code_hash"],
            {run.facts["scenario"]: run.facts["fmu"] for run in plan.runs},
        )
        self._runs = {str(run.key): run for run in plan.runs}
        self.stores = {name: RunStore(out, run.key, run.facts) for name, run in self._runs.items()}
        self._done: dict[str, int] = {}
        self._finished: set[str] = set()
        self.failures: dict[str, Failure] = {}
        """What failed, by run."""

    def go(self, jobs: int, scheduler: str | None) -> None:
        """Do all that is not done; raises EvaluationError where no worker can work."""
        tasks: dict[str, Unit] = {}
        for name, run in self._runs.items():
            tasks |= self._next(name, run)
        self._tell("")
        try:
            run_all(perform, tasks.items(), self._take, jobs=jobs, scheduler=scheduler)
        finally:
            release()

    def _next(self, name: str, run: Run) -> dict[str, Unit]:
        """What a run needs next: a piece of its training, or its evaluation."""
        store = self.stores[name]
        progress = store.progress()
        self._done[name] = 0
        if run.training is not None:
            self._done[name] = run.training.samples if progress.ended else progress.samples
            if not progress.ended:
                unit = Advance(self._place, run.training, progress.checkpoint, SLICE)
                return {f"{name}: training": unit}
        return self._evaluations(name, run, progress)

    def _evaluations(self, name: str, run: Run, progress: Progress) -> dict[str, Unit]:
        controller: str | Learnt = run.case.controller or ""
        if run.training is not None:
            controller = Learnt(run.training, progress.parameters)
        units: dict[str, Unit] = {}
        store = self.stores[name]
        place, scenario = self._place, self._plan.definition.scenarios[run.key.scenario]
        for file, (seeds, steps) in run.noise.items():
            missing = store.missing(file, seeds, steps)
            self._done[name] += (len(seeds) - len(missing)) * steps
            size = max(1, BLOCK // steps)
            for first in range(0, len(missing), size):
                block = tuple(missing[first : first + size])
                units[f"{name}: {file} {block[0]}"] = Evaluate(
                    place, name, scenario, controller, steps, block
                )
        for trace in run.traces:
            if store.trajectory(trace) is not None:
                self._done[name] += trace.steps
                continue
            units[f"{name}: {trace.name}"] = Trace(
                place, name, scenario, controller, trace.steps, trace.seed
            )
        if (online := run.online) is not None:
            beside = store.missing_online(online)
            self._done[name] += online.steps * (len(online.seeds) - len(beside))
            for seed in beside:
                units[f"{name}: online {seed}"] = Accompany(
                    place, name, scenario, controller, online.steps, seed, online.block
                )
        if not units:
            self._finished.add(name)
        return units

    def _take(self, task: str, outcome: Outcome) -> Mapping[str, Unit] | None:
        """Store what a unit gave and say so; returns what can be done now."""
        name, _, what = task.rpartition(": ")
        run, store = self._runs[name], self.stores[name]
        if isinstance(outcome, Failure):
            self.failures.setdefault(name, outcome)
            store.fail(outcome.trace)
            self._tell(f"failed: {name}: {outcome.message}")
            return None
        if isinstance(outcome, Progress):
            before = store.progress().wall_seconds
            store.advance(replace(outcome, wall_seconds=before + outcome.wall_seconds))
            more = self._next(name, run)
            ended = outcome.status if outcome.status not in ("", "finished") else ""
            self._tell(f"{name}: {ended}" if ended else "")
            return more
        if isinstance(outcome, Traced):
            trace = next(trace for trace in run.traces if trace.name == what)
            store.trace(trace, outcome.trajectory)
            self._done[name] += trace.steps
            self._tell(self._finish(name, run))
            return None
        if isinstance(outcome, Accompanied):
            assert run.online is not None
            store.accompany(run.online, outcome.seed, outcome.costs)
            self._done[name] += run.online.steps
            self._tell(self._finish(name, run))
            return None
        assert isinstance(outcome, Evaluated)
        file = what.split()[0]
        _, steps = run.noise[file]
        store.evaluate(file, steps, outcome.indicators)
        store.used(outcome.functions)
        self._done[name] += len(outcome.indicators) * steps
        self._tell(self._finish(name, run))
        return None

    def _finish(self, name: str, run: Run) -> str:
        """A line for a run whose last evaluation just came, else nothing."""
        store = self.stores[name]
        if any(store.trajectory(trace) is None for trace in run.traces):
            return ""
        if store.missing_online(run.online):
            return ""
        if any(store.missing(file, seeds, steps) for file, (seeds, steps) in run.noise.items()):
            return ""
        seeds, steps = run.noise[EVALUATION]
        found = store.indicators(EVALUATION, steps)
        self._finished.add(name)
        status = store.progress().status.partition(":")[0]
        cost = sum(found[seed]["J"] for seed in seeds) / len(seeds)
        return f"{name}: J {cost:.6g}{f', {status}' if status else ''}"

    def _tell(self, line: str) -> None:
        state = State(
            sum(self._done.values()),
            len(self._finished),
            len(self._runs),
            len(self.failures),
        )
        self._report(state, line)
