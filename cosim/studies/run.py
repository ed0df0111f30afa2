"""Runs a plan: work items on this machine's cores or a Dask cluster, stored as they end."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import loky

from cosim.errors import EvaluationError, FailedRunsError
from cosim.files import write_atomically
from cosim.processes import without_interrupts
from cosim.simulation import reporting
from cosim.studies import operation
from cosim.studies.plan import Plan, Study, plan
from cosim.studies.results import StudyResults
from cosim.studies.store import EVALUATION, FAILURE, RunStore
from cosim.studies.work import Failure, Item, Outcome, Run, Trained, begin, perform
from cosim.validation import known_keywords

ANSWER_SECONDS = 10.0
"""Time in which a scheduler answers."""
WORKER_SECONDS = 300.0
"""Time for which a cluster may be without a worker while there is work."""
ITEM = 20_000
"""Samples of an item of evaluation, about: a few seconds of work."""
ROUNDS = 3
"""Times that workers may die without having finished one item."""


Report = Callable[[int, str, str], None]
"""Called with the plant samples done, the runs done in words, and a line about an event, or ""."""


class Runner:
    """Does the runs of a plan that `out` lacks (`RunStore`)."""

    def __init__(self, runs: list[Run], out: Path, folders: tuple[Path, ...], report: Report):
        self._runs = {str(run.key): run for run in runs}
        self._report, self._folders = report, tuple(map(str, dict.fromkeys(folders)))
        self.stores = {name: RunStore(out, run) for name, run in self._runs.items()}
        self.failures: dict[str, Failure] = {}
        """The first failure of each run that failed."""
        self._done = dict.fromkeys(self._runs, 0)
        self._finished: set[str] = set()
        self.remarks = list(dict.fromkeys(x for s in self.stores.values() for x in s.remarks))
        """What was changed or damaged and is done anew, in words."""

    def run(self, jobs: int, scheduler: str | None) -> None:
        """Do all that is not done; failed runs do not stop the others.

        Raises EvaluationError where no worker can work.
        """
        if jobs < 1:
            raise EvaluationError(f"jobs must be at least 1, not {jobs}")
        fruitless = 0
        while items := self._missing(shared_disk=scheduler is None):
            fruitless += 1
            try:
                with closing(_outcomes(items, jobs, scheduler)) as outcomes:
                    for item, outcome in outcomes:
                        self._take(item, outcome)
                        fruitless = 0
            except BrokenProcessPool as error:
                if fruitless == ROUNDS:
                    raise EvaluationError(
                        f"the workers died {ROUNDS} times without finishing one of the work "
                        f"items left ({error}); run with --jobs 1 to see why"
                    ) from None
            finally:
                for store in self.stores.values():
                    store.flush()

    def _missing(self, shared_disk: bool) -> list[Item]:
        """Items that can be done now: a training, or evaluations after its end."""
        items: list[Item] = []
        for name, run in self._runs.items():
            if name in self.failures or name in self._finished:
                continue
            items += self._items(name, run, shared_disk)
            self._finish(name, run)
        self._tell("")
        return items

    def _items(self, name: str, run: Run, shared_disk: bool) -> Iterator[Item]:
        store, base = self.stores[name], Item(run, self._folders)
        self._done[name] = 0
        if run.training is not None:
            if not store.status:
                store.unseal()
                yield replace(base, folder=store.folder.absolute() if shared_disk else None)
                return
            base = replace(base, parameters=store.parameters)
            self._done[name] = run.training.samples
        for file, noise in run.noise.items():
            missing = noise._replace(seeds=store.missing(file))
            self._done[name] += noise.samples - missing.samples
            size = max(1, ITEM // (noise.burn_in + noise.steps))
            theta: tuple[float, ...] = ()
            if noise.mark and missing.seeds and run.training is not None:
                theta = operation.theta_at(store.log, noise.mark)
            for first in range(0, len(missing.seeds), size):
                part = missing._replace(seeds=missing.seeds[first : first + size])
                yield replace(base, file=file, noise=part, theta=theta)

    def _take(self, item: Item, outcome: Outcome) -> None:
        """Store and report the outcome of an item."""
        name = str(item.run.key)
        store = self.stores[name]
        if isinstance(outcome, Failure):
            if name not in self.failures:
                self.failures[name] = outcome
                write_atomically(store.folder / FAILURE, outcome.traceback)
                self._tell(f"failed: {name}: {outcome.message}")
            return
        store.unseal()
        self._done[name] += item.noise.samples
        if isinstance(outcome, Trained):
            store.train(outcome)
            self._done[name] = outcome.samples
            self._tell("" if outcome.status == "finished" else f"{name}: {outcome.status}")
            return
        if isinstance(outcome, str):
            write_atomically(store.folder / item.file, outcome)
        else:
            store.evaluate(item.file, outcome)
        self._tell(self._finish(name, item.run))

    def _finish(self, name: str, run: Run) -> str:
        """Seal a complete run; returns a line about it."""
        store = self.stores[name]
        if not store.finished:
            return ""
        store.seal()
        self._finished.add(name)
        found = store.indicators(EVALUATION)
        seeds = run.noise[EVALUATION].seeds
        cost = sum(found[seed]["J"] for seed in seeds) / len(seeds)
        status = store.status.partition(":")[0]
        return f"{name}: J {cost:.6g}{f', {status}' if status else ''}"

    def _tell(self, line: str) -> None:
        failed = f", {len(self.failures)} failed" if self.failures else ""
        runs = f"{len(self._finished)}/{len(self._runs)} runs{failed}"
        self._report(sum(self._done.values()), runs, line)


def _outcomes(
    items: list[Item], jobs: int, scheduler: str | None
) -> Generator[tuple[Item, Outcome], None, None]:
    """Do items in this process, in `jobs` processes or on a cluster, in no certain order."""
    if scheduler is not None:
        yield from _on_cluster(scheduler, items)
        return
    if jobs == 1:
        yield from map(perform, items)
        return
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    workers = loky.ProcessPoolExecutor(
        min(jobs, len(items)), initializer=begin, initargs=(os.getpid(),), env=one_thread
    )
    try:
        with without_interrupts():
            ended = [workers.submit(perform, item) for item in items]
        for future in loky.as_completed(ended):
            yield future.result()
    finally:
        workers.shutdown(wait=True, kill_workers=True)


def _on_cluster(address: str, items: list[Item]) -> Iterator[tuple[Item, Outcome]]:
    """Run items on an existing scheduler's workers; yield them as they end.

    Raises EvaluationError where the scheduler fails, is silent or has no worker, and where a worker
    cannot do an item.
    """
    try:
        dask: Any = import_module("distributed")
    except ImportError:
        raise EvaluationError(
            "a Dask scheduler needs the extra 'cluster': pip install 'rti-cosim[cluster]'"
        ) from None
    ended: SimpleQueue[Any] = SimpleQueue()
    level = logging.root.manager.disable
    logging.disable()  # the exception says what went wrong, once
    try:
        # Ask the address first: a client made where nobody answers can hang when it ends.
        if asyncio.run(_identity(dask, address)).get("type") != "Scheduler":
            raise OSError("what answers is no scheduler")
        client = dask.Client(address, timeout=f"{ANSWER_SECONDS} s", set_as_default=False)
        try:
            for future in client.map(perform, items, pure=False):
                future.add_done_callback(ended.put)
            worked = time.monotonic()
            for _ in items:
                while True:
                    with suppress(Empty):
                        future = ended.get(timeout=ANSWER_SECONDS)
                        break
                    if asyncio.run(_identity(dask, address))["workers"]:
                        worked = time.monotonic()
                    elif time.monotonic() - worked > WORKER_SECONDS:
                        raise OSError(f"it has had no worker for {WORKER_SECONDS:g} s")
                yield future.result()
        finally:
            with suppress(Exception):
                client.close(timeout=ANSWER_SECONDS)
    except Exception as error:
        text = f"no answer within {ANSWER_SECONDS:g} s" if type(error) is TimeoutError else error
        said = " ".join(str(text).split())[:300] or type(error).__name__
        raise EvaluationError(
            f"the Dask cluster at '{address}' failed: {said}; what is finished is stored: give the "
            "same command again, with the same rti-cosim and what the items need on all workers"
        ) from None
    finally:
        logging.disable(level)


async def _identity(dask: Any, address: str) -> dict[str, Any]:
    """A scheduler's identity; raises TimeoutError without an answer."""
    security = dask.Security().get_connection_args("client")
    async with (
        asyncio.timeout(ANSWER_SECONDS),
        dask.rpc(address, connection_args=security) as scheduler,
    ):
        return dict(await scheduler.identity())


@known_keywords
def study(
    source: Study | str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Report | bool = False,
    planned: Plan | None = None,
    figures: bool = True,
) -> StudyResults:
    """Do the runs of a study that `out` lacks, and write its tables there.

    Raises StudyError and what scenarios and algorithms raise before any work is done;
    FailedRunsError after all other runs are done and written.

    Args:
        source: a study, its file, or the same document as a mapping.
        jobs: worker processes; 1 works in this process. No byte of a table depends on it.
        scheduler: address of a Dask scheduler, used in place of `jobs`.
        progress: a `Report`, called after every work item, and with a line for each run that ends;
            True draws a bar.
        planned: the study's plan, if it is known.
        figures: whether the study's trajectories and logs are drawn.
    """
    if isinstance(source, Mapping):
        source = Study.from_dict(source)
    definition, folder = source if isinstance(source, Study) else Study.load(source), Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    planned = planned or plan(definition)
    with reporting(progress, definition.name, planned.samples) as report:
        runner = Runner(planned.runs, folder, (definition.folder, Path.cwd()), report)
        for line in runner.remarks:
            report(0, "", line)
        runner.run(jobs, scheduler)
    stores = runner.stores.values()
    results = StudyResults.written(planned, folder, stores, draw=figures)
    if runner.failures:
        name, failure = next(iter(runner.failures.items()))
        others = f" ({more} more failed)" if (more := len(runner.failures) - 1) else ""
        raise FailedRunsError(f"{name}: {failure.message}{others}; run again to try anew")
    return results
