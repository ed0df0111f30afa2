"""A Dask cluster that somebody else runs: reached, watched and left, each within a time."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from importlib import import_module
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from cosim.errors import EvaluationError

ANSWER_SECONDS = 10.0
"""Time in which a scheduler answers."""
WORKER_SECONDS = 300.0
"""Time for which a cluster may be without a worker while there is work."""
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def on_cluster(
    address: str, work: Callable[[Item], Outcome], items: Sequence[Item]
) -> Iterator[Outcome]:
    """Do `work` on items on the workers of a scheduler; outcomes in the order in which they end.

    A scheduler that dies or is silent ends in EvaluationError, of one line. What the work itself
    raises goes through.
    """
    with _client(address) as (dask, client), _translated(dask, address):
        ended: SimpleQueue[Any] = SimpleQueue()
        futures = client.map(work, items, pure=False)
        for future in futures:
            future.add_done_callback(ended.put)
        worked = time.monotonic()
        for _ in items:
            while True:
                try:
                    future = ended.get(timeout=ANSWER_SECONDS)
                    break
                except Empty:
                    if asyncio.run(_identity(dask, address))["workers"]:
                        worked = time.monotonic()
                    elif time.monotonic() - worked > WORKER_SECONDS:
                        raise _without_worker(address) from None
            outcome: Outcome = future.result()
            yield outcome


@contextmanager
def _client(address: str) -> Iterator[tuple[Any, Any]]:
    """Dask and a client of a scheduler that has just answered and has a worker."""
    try:
        dask: Any = import_module("distributed")
    except ImportError:
        raise EvaluationError(
            "a Dask scheduler needs the extra 'cluster': pip install 'rti-cosim[cluster]'"
        ) from None
    with _quiet():
        # A client made for an address where nobody answers can hang when it is dropped.
        try:
            found = asyncio.run(_identity(dask, address))
            if not isinstance(found, dict) or found.get("type") != "Scheduler":
                raise ValueError("what answers is no scheduler")
            client = dask.Client(address, timeout=f"{ANSWER_SECONDS} s", set_as_default=False)
        except Exception as error:
            raise EvaluationError(
                f"the Dask cluster at '{address}' does not answer: {_line(error)}"
            ) from None
        try:
            client.wait_for_workers(1, timeout=WORKER_SECONDS)
            yield dask, client
        except TimeoutError:
            raise _without_worker(address) from None
        finally:
            with suppress(Exception):
                client.close(timeout=ANSWER_SECONDS)


@contextmanager
def _translated(dask: Any, address: str) -> Iterator[None]:
    """Say in a line what becomes of a cluster."""
    same = (
        "install the same version of rti-cosim, and what the items need, on scheduler and workers"
    )
    try:
        yield
    except dask.KilledWorker as error:
        text = f"workers of the cluster died again and again: {_line(error)}"
    except ModuleNotFoundError as error:
        text = f"a worker of the cluster cannot import '{error.name}'; {same}"
    except (CancelledError, OSError, TimeoutError) as error:
        text = (
            f"the Dask cluster at '{address}' is gone or does not answer ({_line(error)}); what is "
            "finished is stored: the same command goes on"
        )
    except RuntimeError as error:
        if "deserialization" not in str(error):
            raise
        text = f"the Dask cluster at '{address}' cannot read its items; {same}"
    else:
        return
    raise EvaluationError(text)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's log: the exception says what went wrong, once."""
    names = [n for n in logging.Logger.manager.loggerDict if n.partition(".")[0] == "distributed"]
    levels = {logger: logger.level for logger in map(logging.getLogger, names)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _without_worker(address: str) -> EvaluationError:
    return EvaluationError(
        f"the Dask cluster at '{address}' has had no worker for {WORKER_SECONDS:g} s; start some, "
        f"with the same version of rti-cosim: dask worker {address}"
    )


async def _identity(dask: Any, address: str) -> Any:
    """What a scheduler says of itself; raises TimeoutError where it says nothing."""
    connect = import_module("distributed.comm").connect
    async with asyncio.timeout(ANSWER_SECONDS):
        security = dask.Security().get_connection_args("client")
        comm = await connect(address, timeout=ANSWER_SECONDS, **security)
        try:
            await comm.write({"op": "identity", "reply": True})
            return await comm.read()
        finally:
            comm.abort()


def _line(error: BaseException) -> str:
    """What an error says, or is, in at most a line."""
    if isinstance(error, TimeoutError):
        return f"no answer within {ANSWER_SECONDS:g} s"
    return " ".join(str(error).split())[:300] or type(error).__name__
