"""Runs independent tasks on this machine's cores (loky) or a cluster (Dask distributed)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TypeVar

import loky

from cosim.errors import EvaluationError

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
    tasks: Mapping[str, Task],
    done: Callable[[str, Outcome], None],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> None:
    """Call `done(key, function(task))` for every task, as they finish, in no certain order.

    `done` runs in this process, so what it stores survives whatever becomes of the workers. With
    `scheduler` the tasks go to that Dask cluster; else to `jobs` processes, or none for one job.
    A worker that dies takes down only the tasks it had not finished; they are given out again.

    Raises EvaluationError if the cluster cannot be reached, or if the workers die `ROUNDS` times
    without finishing anything; the first exception of a task ends the run and is raised.
    """
    if jobs < 1:
        raise EvaluationError(f"jobs must be at least 1, not {jobs}")
    if scheduler is None and (jobs == 1 or len(tasks) < 2):
        for key, task in tasks.items():
            done(key, function(task))
        return
    left = dict(tasks)
    fruitless = 0
    while left:
        before = len(left)
        try:
            with _executor(min(jobs, before), scheduler) as executor:
                futures = {executor.submit(function, task): key for key, task in left.items()}
                _collect(futures, left, done)
        except BrokenProcessPool as error:
            fruitless = fruitless + 1 if len(left) == before else 0
            if fruitless == ROUNDS:
                raise EvaluationError(
                    f"the workers died {ROUNDS} times without finishing one of {before} work units "
                    f"({error}); run with --jobs 1 to see why"
                ) from None


def _collect(
    futures: Mapping[Future[Any], str], left: dict[str, Any], done: Callable[[str, Any], None]
) -> None:
    broken: BrokenProcessPool | None = None
    for future in as_completed(futures):
        try:
            outcome = future.result()
        except BrokenProcessPool as error:
            # Futures that finished before the pool broke still come and still count.
            broken = error
            continue
        key = futures[future]
        done(key, outcome)
        del left[key]
    if broken is not None:
        raise broken


@contextmanager
def _executor(jobs: int, scheduler: str | None) -> Iterator[Executor]:
    if scheduler is not None:
        with _cluster(scheduler) as executor:
            yield executor
        return
    executor = loky.ProcessPoolExecutor(max_workers=jobs, env=ENVIRONMENT | _inherited())
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=True, kill_workers=True)
        raise
    executor.shutdown(wait=True)


def _inherited() -> dict[str, str]:
    """What the user set for threads stands."""
    return {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
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
        yield client.get_executor(pure=False)
    except dask.KilledWorker as error:
        raise EvaluationError(f"workers of the cluster died again and again: {error}") from None
    finally:
        client.close()
