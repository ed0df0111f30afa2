"""Runs independent tasks on this machine's cores (loky) or a cluster (Dask distributed)."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

import loky

from cosim.errors import EvaluationError
from cosim.evaluation.cluster import cluster
from cosim.files import temporary_folder
from cosim.processes import follow_parent, out_of_reach_of_ctrl_c

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

ROUNDS = 3
LOOK_SECONDS = 30.0
"""Without a finished task after which a cluster is asked whether it is still there."""
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
            with _crew(jobs, scheduler) as crew:
                _feed(crew, function, waiting, count)
        except BrokenProcessPool as error:
            fruitless = 0 if finished else fruitless + 1
            if fruitless == ROUNDS:
                raise EvaluationError(
                    f"the workers died {ROUNDS} times without finishing one of the work "
                    f"units left ({error}); run with --jobs 1 to see why"
                ) from None


@dataclass(frozen=True)
class _Crew:
    """Who works: how a task is given out, how many workers there are, whether they still are there.

    `look` raises EvaluationError where they are not; `translated` says in a line what they raise.
    """

    submit: Callable[..., Future[Any]]
    workers: Callable[[], int]
    look: Callable[[], None] = lambda: None
    translated: Callable[[], AbstractContextManager[None]] = nullcontext


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
    crew: _Crew,
    function: Callable[[Any], Any],
    waiting: _Queue,
    done: Callable[[str, Any], Mapping[str, Any] | None],
) -> None:
    """Give out tasks, a few more than there are workers; what was not finished waits again."""
    given: dict[Future[Any], tuple[str, Any]] = {}
    broken: BrokenProcessPool | None = None
    try:
        while given or (waiting and broken is None):
            limit = 2 * crew.workers() if broken is None else 0
            while waiting and len(given) < limit:
                key, task = waiting.take()
                with crew.translated():
                    given[crew.submit(function, task)] = (key, task)
            finished, _ = wait(given, LOOK_SECONDS, return_when=FIRST_COMPLETED)
            if not finished:
                crew.look()
            for future in finished:
                key, task = given.pop(future)
                try:
                    with crew.translated():
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
def _crew(jobs: int, scheduler: str | None) -> Iterator[_Crew]:
    if scheduler is not None:
        with cluster(scheduler) as there:
            yield _Crew(there.executor.submit, there.workers, there.look, there.translated)
        return
    # The workers' temporary files, which a worker that is killed leaves to us.
    with temporary_folder("cosim-") as temporary:
        executor = loky.ProcessPoolExecutor(
            max_workers=jobs,
            env=ENVIRONMENT
            | _inherited()
            | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(temporary)),
            initializer=follow_parent,
            initargs=(os.getpid(),),
        )

        def submit(function: Callable[[Any], Any], task: Any) -> Future[Any]:
            with out_of_reach_of_ctrl_c():  # the first one starts the workers
                future: Future[Any] = executor.submit(function, task)
            return future

        try:
            yield _Crew(submit, lambda: jobs)
        except BaseException:
            executor.shutdown(wait=True, kill_workers=True)
            raise
        executor.shutdown(wait=True)


def _inherited() -> dict[str, str]:
    """What the user set for threads stands."""
    return {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}
