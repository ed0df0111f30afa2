"""A Dask cluster that somebody else runs: reached, watched and left, each within a time."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

from cosim.errors import EvaluationError

ANSWER_SECONDS = 10.0
"""Within which a scheduler answers."""
WORKER_SECONDS = 300.0
"""For which a cluster may be without a worker while there is work."""
# Evaluated by every worker that is there, which may lack this very module.
_OURS = "__import__('cosim.evaluation.unit') and None"


class Cluster:
    """A scheduler with a client of ours.

    All that it raises about the cluster is EvaluationError, in one line.
    """

    def __init__(self, dask: Any, client: Any, address: str) -> None:
        self._dask, self._client, self._address = dask, client, address
        self._worked = time.monotonic()
        self.executor: Executor = client.get_executor(pure=False)

    def workers(self) -> int:
        """Number of threads that work; at least 1, since a worker may come again."""
        with self.translated():
            threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def look(self) -> None:
        """Raise EvaluationError where the scheduler is silent, or has long had no worker."""
        with self.translated():
            asked = asyncio.run(_identity(self._dask, self._address))
        now = time.monotonic()
        if asked["workers"]:
            self._worked = now
        elif now - self._worked > WORKER_SECONDS:
            raise _without_worker(self._address)

    @contextmanager
    def translated(self) -> Iterator[None]:
        """Say in a line what becomes of a cluster; what a task raised itself goes through."""
        try:
            yield
        except self._dask.KilledWorker as error:
            raise EvaluationError(
                f"workers of the cluster died again and again: {_line(error)}"
            ) from None
        except ModuleNotFoundError as error:
            raise EvaluationError(
                f"a worker of the cluster cannot import '{error.name}'; install the same version "
                "of rti-cosim, and what the task needs, on scheduler and workers"
            ) from None
        except (CancelledError, OSError, TimeoutError) as error:
            raise EvaluationError(
                f"the Dask scheduler at '{self._address}' is gone or does not answer "
                f"({_line(error)}); what is finished is stored: the same command goes on"
            ) from None
        except RuntimeError as error:
            if "deserialization" not in str(error):
                raise
            raise EvaluationError(
                f"the Dask scheduler at '{self._address}' cannot read its tasks; install the same "
                "version of rti-cosim, and what the task needs, on scheduler and workers"
            ) from None


@contextmanager
def cluster(address: str) -> Iterator[Cluster]:
    """A cluster by its scheduler's address; raises EvaluationError where none answers there."""
    try:
        dask: Any = import_module("distributed")
    except ImportError:
        raise EvaluationError(
            "a Dask scheduler needs the extra 'cluster': pip install 'rti-cosim[cluster]'"
        ) from None
    with _quiet():
        client = _connect(dask, address)
        try:
            _require_ours(client, address)
            yield Cluster(dask, client, address)
        finally:
            with suppress(Exception):
                client.close(timeout=ANSWER_SECONDS)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Dask's log: what goes wrong is said once, by the exception."""
    names = [n for n in logging.Logger.manager.loggerDict if n.partition(".")[0] == "distributed"]
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _require_ours(client: Any, address: str) -> None:
    """Wait for a worker; raise EvaluationError where one lacks the package.

    It would close down over its first task without a word.
    """
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError:
        raise _without_worker(address) from None
    try:
        answers = client.run(eval, _OURS, on_error="return", callback_timeout=ANSWER_SECONDS)
    except Exception:  # a worker that is silent or going; the others do the work
        return
    for worker, answer in answers.items():
        if isinstance(answer, ImportError):
            raise EvaluationError(
                f"worker {worker} of the cluster cannot import rti-cosim ({_line(answer)}); "
                "install the same version on scheduler and workers"
            )


def _without_worker(address: str) -> EvaluationError:
    return EvaluationError(
        f"the Dask cluster at '{address}' has had no worker for {WORKER_SECONDS:g} s; start some, "
        f"with the same version of rti-cosim: dask worker {address}"
    )


def _connect(dask: Any, address: str) -> Any:
    # A client that was given an address of no form, or one where nobody answers, hangs when it is
    # dropped: it is made for a scheduler that has just answered.
    try:
        found = asyncio.run(_identity(dask, address))
        if found.get("type") != "Scheduler":
            raise ValueError(f"a {found.get('type', 'program')} answers, not a scheduler")
        return dask.Client(address, timeout=f"{ANSWER_SECONDS} s", set_as_default=False)
    except Exception as error:
        raise EvaluationError(f"no Dask scheduler answers at '{address}': {_line(error)}") from None


async def _identity(dask: Any, address: str) -> dict[str, Any]:
    """What a scheduler says of itself; raises TimeoutError where it says nothing."""
    return await asyncio.wait_for(_ask(dask, address), ANSWER_SECONDS)


async def _ask(dask: Any, address: str) -> dict[str, Any]:
    security = dask.Security().get_connection_args("client")
    comm = await import_module("distributed.comm").connect(
        address, timeout=ANSWER_SECONDS, **security
    )
    try:
        await comm.write({"op": "identity", "reply": True})
        answer: Any = await comm.read()
    finally:
        comm.abort()
    if not isinstance(answer, dict):
        raise ValueError("what answers does not speak as Dask does")
    return answer


def _line(error: BaseException) -> str:
    """What an error says, or is, in at most a line."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, TimeoutError):
        return f"no answer within {ANSWER_SECONDS:g} s"
    return text if len(text) <= 300 else f"{text[:300]}…"
