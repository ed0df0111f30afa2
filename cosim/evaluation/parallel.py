"""Runs independent tasks on this machine's cores (loky) or a cluster (Dask distributed)."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from itertools import islice
from typing import Any, TypeVar

import loky

from cosim.errors import EvaluationError
from cosim.lifetime import follow_parent

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

ROUNDS = 3
# One thread per worker: more would only fight over the cores that the workers share.
ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def cores() -> int:
    """Number of cores that this process may use."""
    return int(loky.cpu_count())


def run_all(
    function: Callable[[Task], Outcome],
    tasks: Iterable[tuple[str, Task]],
    done: Callable[[str, Outcome], Mapping[str, Task] | None],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> None:
    """Call `done(key, function(task))` for every (key, task), as they finish, in no certain order.

    What `done` returns are further tasks, which come before those that wait. `done` runs in this
    process, so what it stores survives whatever becomes of the workers. With `scheduler` the tasks
    go to that Dask cluster; else to `jobs` processes, or none for one job. Only as many are taken
    from `tasks`, and given out, as keep the workers busy. A worker that dies takes down only the
    tasks it had not finished; they are given out again.

    Raises EvaluationError if the cluster cannot be reached, or if the workers die `ROUNDS` times
    without finishing anything; the first exception of a task ends the run and is raised.
    """
    if jobs < 1:
        raise EvaluationError(f"jobs must be at least 1, not {jobs}")
    waiting = _Queue(tasks)
    if scheduler is None and jobs == 1:
        while waiting:
            key, task = waiting.take()
            waiting.put_first(done(key, function(task)))
        return
    fruitless = 0
    while waiting:
        finished = False

        def count(key: str, outcome: Outcome) -> Mapping[str, Task] | None:
            nonlocal finished
            finished = True
            return done(key, outcome)

        try:
            with _executor(jobs, scheduler) as (executor, workers):
                _feed(executor, workers, function, waiting, count)
        except BrokenProcessPool as error:
            fruitless = 0 if finished else fruitless + 1
            if fruitless == ROUNDS:
                raise EvaluationError(
                    f"the workers died {ROUNDS} times without finishing one of the work "
                    f"units left ({error}); run with --jobs 1 to see why"
                ) from None


class _Queue:
    """Tasks that wait: those put back or added in front, then what the source still holds."""

    def __init__(self, source: Iterable[tuple[str, Any]]) -> None:
        self._source = iter(source)
        self._front: deque[tuple[str, Any]] = deque()

    def __bool__(self) -> bool:
        if not self._front:
            self._front.extend(islice(self._source, 1))
        return bool(self._front)

    def take(self) -> tuple[str, Any]:
        """The next task, after `bool` has said that there is one."""
        return self._front.popleft()

    def put_first(self, tasks: Mapping[str, Any] | None) -> None:
        self._front.extendleft(reversed(list((tasks or {}).items())))


def _feed(
    executor: Executor,
    workers: Callable[[], int],
    function: Callable[[Any], Any],
    waiting: _Queue,
    done: Callable[[str, Any], Mapping[str, Any] | None],
) -> None:
    """Give out tasks, a few more than there are workers; what was not finished waits again."""
    given: dict[Future[Any], tuple[str, Any]] = {}
    broken: BrokenProcessPool | None = None
    try:
        while given or (waiting and broken is None):
            limit = 2 * workers() if broken is None else 0
            while waiting and len(given) < limit:
                key, task = waiting.take()
                given[executor.submit(function, task)] = (key, task)
            finished, _ = wait(given, return_when=FIRST_COMPLETED)
            for future in finished:
                key, task = given.pop(future)
                try:
                    outcome = future.result()
                except BrokenProcessPool as error:
                    # Futures that finished before the pool broke still come and still count.
                    broken = error
                    waiting.put_first({key: task})
                    continue
                waiting.put_first(done(key, outcome))
    except BrokenProcessPool as error:  # of submit: the pool broke while nothing was awaited
        broken = error
        waiting.put_first({key: task})
        for key, task in given.values():
            waiting.put_first({key: task})
    if broken is not None:
        raise broken


@contextmanager
def _executor(jobs: int, scheduler: str | None) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """An executor, and a function that says how many workers it has now."""
    if scheduler is not None:
        with _cluster(scheduler) as cluster:
            yield cluster
        return
    executor = loky.ProcessPoolExecutor(
        max_workers=jobs, env=ENVIRONMENT | _inherited(), initializer=follow_parent
    )
    try:
        yield executor, lambda: jobs
    except BaseException:
        executor.shutdown(wait=True, kill_workers=True)
        raise
    executor.shutdown(wait=True)


def _inherited() -> dict[str, str]:
    """What the user set for threads stands."""
    return {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}


@contextmanager
def _cluster(address: str) -> Iterator[tuple[Executor, Callable[[], int]]]:
    try:
        dask: Any = import_module("distributed")
    except ImportError:
        raise EvaluationError(
            "a Dask scheduler needs the extra 'cluster': pip install 'rti-cosim[cluster]'"
        ) from None
    try:
        client = dask.Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise EvaluationError(f"no Dask scheduler answers at '{address}': {error}") from None
    try:
        # A cluster without workers is given something to do: one may come.
        yield client.get_executor(pure=False), lambda: max(1, sum(client.nthreads().values()))
    except dask.KilledWorker as error:
        raise EvaluationError(f"workers of the cluster died again and again: {error}") from None
    finally:
        client.close()
