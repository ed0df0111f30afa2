"""Work given out: to this process, to several, or to the workers of a Dask cluster."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Generic, Self, TextIO, TypeVar

import numpy as np

from cosim.core.errors import CosimWarning, EvaluationError, warn
from cosim.core.files import temporary_folder
from cosim.core.modules import OURS, import_folders, import_from, users_place
from cosim.core.processes import Terminated, follow_parent, without_interrupts
from cosim.core.scenario import Scenario, is_file
from cosim.core.validation import whole_number
from cosim.identity import changed, depends_on

ANSWER_SECONDS = 10.0
"""Time in which a scheduler answers."""
WORKER_SECONDS = 300.0
"""Time for which a cluster may be without a worker while there is work."""
ROUNDS = 3
"""Times that workers may die without having finished one item."""
PROGRESS_SECONDS = 1.0
"""Seconds between two looks at how far workers have come."""
SamplesDone = Callable[[int], None]
"""Called with a number of plant samples."""
Key = TypeVar("Key", bound=Hashable)
Outcome = TypeVar("Outcome")


@dataclass(frozen=True)
class Failure:
    """A failed item: message, traceback, and the class of our own errors."""

    message: str
    traceback: str
    kind: type[Exception] | None = None

    def error(self) -> Exception:
        """The error once more; an EvaluationError for that of a plug-in."""
        # Made of its message alone; a class with arguments of its own cannot be made again.
        if self.kind is not None and self.kind.__init__ is Exception.__init__:
            _, _, words = self.message.partition(": ")
            return self.kind(words)
        return EvaluationError(self.message)


@dataclass(frozen=True)
class Conditions:
    """Conditions of an item of work, which a worker must meet.

    Attributes:
        scenario: the whole scenario, with the FMU's absolute path.
        facts: `depends_on` of the scenario, the parts and the files where the work was planned.
        parts: controllers and algorithms that count.
        files: paths of the data files that count, by name.
        folders: where users' modules are searched.
    """

    scenario: Scenario
    facts: Mapping[str, str]
    parts: tuple[Any, ...]
    files: Mapping[str, str]
    folders: tuple[str, ...]

    @classmethod
    def of_now(
        cls,
        scenario: Scenario,
        *parts: Any,
        files: Mapping[str, str] | None = None,
    ) -> Self:
        """The conditions as this process finds them now; raises what `depends_on` raises.

        Args:
            scenario: of the work.
            parts: controllers and algorithms that count.
            files: paths of the data files that count, by name.
        """
        fmu = scenario.plant.fmu
        # A worker may have another working directory.
        if is_file(fmu):
            absolute = str(Path(fmu).resolve())
            scenario = scenario.replace({"plant": {"fmu": absolute}})
        facts = depends_on(scenario, *parts, files=files)
        return cls(
            scenario=scenario,
            facts=facts,
            parts=parts,
            files=files or {},
            folders=import_folders(),
        )

    @property
    def all_ours(self) -> bool:
        """Whether nothing but our own code runs: no plug-in, no FMU in a file."""
        plugins = any(name.startswith("plug-in") for name in self.facts)
        return not plugins and not is_file(self.scenario.plant.fmu)

    def facts_here(self) -> dict[str, str]:
        """This process's own values of `facts`."""
        for folder in self.folders:
            import_from(folder)
        return depends_on(self.scenario, *self.parts, files=self.files)

    def refusal(self, facts: Mapping[str, str]) -> Failure | None:
        """The failure of a worker that met other things than planned; None if it did not."""
        names = changed(self.facts, facts)
        if not names:
            return None
        differences = []
        for name in names:
            differences.append(f"{name} ({facts.get(name)}, not {self.facts.get(name)})")
        if "fmu" in names:
            differences.append(f"the FMU is '{self.scenario.plant.fmu}'")
        message = (
            "EvaluationError: a worker ran with other things than the work was planned with: "
            f"{'; '.join(differences)}; give the command again with the same everywhere"
        )
        return Failure(message, f"{message}\n", EvaluationError)


@dataclass(frozen=True)
class Item(Generic[Outcome]):
    """A unit of work of one process, whole by its content; `run` does it."""

    conditions: Conditions

    def run(self, progress: SamplesDone) -> Outcome:
        """Do the work.

        Args:
            progress: called now and then with the item's plant samples so far.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Report(Generic[Outcome]):
    """Report of a worker about an item.

    Attributes:
        facts: what it ran with.
        result: of the item, or its failure.
        warnings: message and class of each warning that a process of its own has given.
    """

    facts: Mapping[str, str]
    result: Outcome | Failure
    warnings: tuple[tuple[str, type[CosimWarning]], ...] = ()


def ignored(samples: int) -> None:
    """A `SamplesDone` that nobody follows."""


def _paced(progress: SamplesDone) -> SamplesDone:
    """The same, called at most as often as somebody looks."""
    called_at = time.perf_counter()

    def call(samples: int) -> None:
        nonlocal called_at
        now = time.perf_counter()
        if now - called_at >= PROGRESS_SECONDS / 2:
            called_at = now
            progress(samples)

    return call


def perform(item: Item[Outcome], progress: SamplesDone = ignored) -> Report[Outcome]:
    """Do an item in this process; any exception, `sys.exit` too, becomes a Failure.

    Args:
        item: the work.
        progress: called now and then with the item's plant samples so far.
    """
    facts: Mapping[str, str] = {}
    try:
        facts = item.conditions.facts_here()
        refusal = item.conditions.refusal(facts)
        if refusal is not None:
            return Report(facts, refusal)
        result = item.run(_paced(progress))
        # Data files and plug-ins may have been edited meanwhile.
        return Report(item.conditions.facts_here(), result)
    except (KeyboardInterrupt, Terminated):
        raise
    except BaseException as error:
        return Report(facts, _failure(error))


def _failure(error: BaseException) -> Failure:
    """An exception that is handled now as a Failure, which any process can read."""
    name = type(error).__name__
    words = str(error).split()
    text = " ".join(words) or name
    package, _, _ = type(error).__module__.partition(".")
    kind: type[Exception] | None = None
    # Classes of others need not be there where the error is raised again.
    if isinstance(error, Exception) and package in OURS:
        kind = type(error)
    place = users_place(error)
    message = f"{name}: {text}"
    if place:
        message = f"{place}: {message}"
    return Failure(message, traceback.format_exc(), kind)


def done(
    items: Mapping[Key, Item[Outcome]],
    jobs: int,
    scheduler: str | None,
    progress: SamplesDone = ignored,
) -> Iterator[tuple[Key, Outcome | Failure]]:
    """Do items; yield the key of each with its result as it ends, in no certain order.

    What a worker has found is compared with the item's facts; a result of others is a Failure.
    Items of workers that died are given out again.

    Args:
        items: the items by key.
        jobs: worker processes; 1 works in this process.
        scheduler: address of a Dask scheduler, used in place of `jobs`.
        progress: called each second or so with the plant samples of the items that are not done
            yet; never by the workers of a scheduler.

    Yields:
        The key of an item, and its result or its failure.

    Raises:
        EvaluationError: no worker can work.
    """
    jobs = whole_number("jobs", jobs, 1, EvaluationError)
    remaining = dict(items)
    fruitless = 0
    while remaining:
        fruitless += 1
        try:
            with closing(_reports(remaining, jobs, scheduler, progress)) as reports:
                for key, report in reports:
                    item = remaining.pop(key)
                    fruitless = 0
                    result = report.result
                    # Each process would say it once more.
                    for message, category in report.warnings:
                        warn(message, category)
                    if not isinstance(result, Failure):
                        refusal = item.conditions.refusal(report.facts)
                        result = refusal or result
                    yield key, result
        # A worker was killed, for want of memory say: what it left is given out again.
        except BrokenProcessPool as error:
            if fruitless == ROUNDS:
                raise EvaluationError(
                    f"the workers died {ROUNDS} times without finishing one of the work "
                    f"items left ({error}); run with --jobs 1 to see why"
                ) from None


def cores() -> int:
    """Cores that this process may use."""
    from loky import cpu_count  # noqa: PLC0415 - a third of a second

    return int(cpu_count())


def begin_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end with it."""
    # Python sets a handler in the main thread alone.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.showwarning = _keep_warning
    follow_parent(parent)


_kept_warnings: list[tuple[str, type[CosimWarning]]] = []
"""Of this worker, since its last report."""


def _keep_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
    *,
    show: Callable[..., None] = warnings.showwarning,
) -> None:
    """Keep one of our own warnings for the report; show another's as Python does."""
    if issubclass(category, CosimWarning):
        _kept_warnings.append((str(message), category))
    else:
        show(message, category, filename, lineno, file, line)


class _Board:
    """Progress of the workers of this machine: samples of each item, in a file.

    Args:
        path: of the file.
        n_items: number of the items.
    """

    def __init__(self, path: Path, n_items: int) -> None:
        self.path = path
        self._samples = np.memmap(path, np.int64, "w+", shape=n_items)

    def total(self) -> int:
        """Samples of all items that are not cleared."""
        return int(self._samples.sum())

    def clear(self, number: int) -> None:
        """Forget the samples of an item, which is done."""
        self._samples[number] = 0


def _write_on_board(path: Path, number: int, samples: int) -> None:
    """Say how far an item has come, in a worker."""
    # A view that nobody follows must not end the work.
    with suppress(OSError, ValueError), path.open("r+b") as board:
        board.seek(8 * number)
        board.write(np.int64(samples).tobytes())


def _with_key(
    key: Key,
    item: Item[Outcome],
    progress: SamplesDone = ignored,
) -> tuple[Key, Report[Outcome]]:
    report = perform(item, progress)
    report = replace(report, warnings=tuple(_kept_warnings))
    _kept_warnings.clear()
    return key, report


def _reports(
    items: Mapping[Key, Item[Outcome]],
    jobs: int,
    scheduler: str | None,
    progress: SamplesDone,
) -> Generator[tuple[Key, Report[Outcome]], None, None]:
    """Reports of items by key, in no certain order."""
    if scheduler is not None:
        yield from _on_cluster(scheduler, items)
        return
    if jobs == 1:
        # A list: the caller removes each item as it is done.
        for key, item in list(items.items()):
            yield _with_key(key, item, progress)
        return
    with temporary_folder("cosim-progress-") as folder:
        board = _Board(folder / "samples", len(items))
        yield from _in_processes(items, jobs, board, progress)


def _in_processes(
    items: Mapping[Key, Item[Outcome]],
    jobs: int,
    board: _Board,
    progress: SamplesDone,
) -> Generator[tuple[Key, Report[Outcome]], None, None]:
    """Reports of items that processes of this machine do."""
    import loky  # noqa: PLC0415 - a third of a second, which work in this process need not take

    # The workers are as many as the cores: more threads would wait for each other.
    one_thread = {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
    }
    workers = loky.ProcessPoolExecutor(
        max_workers=min(jobs, len(items)),
        initializer=begin_worker,
        initargs=(os.getpid(),),
        env=one_thread,
    )
    try:
        numbers: dict[Any, int] = {}
        # Not `loky.wait`: it holds the locks of all futures, and an interruption there would leave
        # them held, for which the shutdown below waits without end.
        ended: SimpleQueue[Any] = SimpleQueue()
        # The workers start with the first item that is given out.
        with without_interrupts():
            for number, (key, item) in enumerate(items.items()):
                tell = partial(_write_on_board, board.path, number)
                future = workers.submit(_with_key, key, item, tell)
                numbers[future] = number
                future.add_done_callback(ended.put)
        n_running = len(numbers)
        while n_running:
            future = None
            with suppress(Empty):
                future = ended.get(timeout=PROGRESS_SECONDS)
            if future is not None:
                n_running -= 1
                board.clear(numbers[future])
                yield future.result()
            progress(board.total())
    finally:
        workers.shutdown(wait=True, kill_workers=True)


def _on_cluster(
    address: str, items: Mapping[Key, Item[Outcome]]
) -> Iterator[tuple[Key, Report[Outcome]]]:
    """Run items on an existing scheduler's workers; yield their reports as they end.

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
    # The exception says what went wrong, once.
    logging.disable()
    try:
        # Ask the address first: a client made where nobody answers can hang when it ends.
        if _identity(dask, address).get("type") != "Scheduler":
            raise OSError("what answers is no scheduler")
        client = dask.Client(address, timeout=f"{ANSWER_SECONDS} s", set_as_default=False)
        try:
            # Not pure: Dask would hand out what it remembers of an equal item.
            futures = client.map(_with_key, list(items), list(items.values()), pure=False)
            for future in futures:
                future.add_done_callback(ended.put)
            for _ in range(len(items)):
                yield _next_ended(dask, address, ended).result()
        finally:
            # What ended the work is what the user has to know.
            with suppress(Exception):
                client.close(timeout=ANSWER_SECONDS)
    except Exception as error:
        text = str(error)
        # asyncio's own has no words.
        if type(error) is TimeoutError:
            text = f"no answer within {ANSWER_SECONDS:g} s"
        one_line = " ".join(text.split())
        reason = one_line[:300] or type(error).__name__
        raise EvaluationError(
            f"the Dask cluster at '{address}' failed: {reason}; give the same command again, with "
            "the same rti-cosim and what the items need on all workers"
        ) from None
    finally:
        logging.disable(level)


def _next_ended(
    dask: Any,
    address: str,
    ended: SimpleQueue[Any],
) -> Any:
    """The next future that has ended; raises OSError where there is no worker for long."""
    waited = 0.0
    while True:
        with suppress(Empty):
            return ended.get(timeout=ANSWER_SECONDS)
        # While there are workers an item may take as long as it likes.
        if _identity(dask, address)["workers"]:
            waited = 0.0
        else:
            waited += ANSWER_SECONDS
        if waited > WORKER_SECONDS:
            raise OSError(f"it has had no worker for {WORKER_SECONDS:g} s")


def _identity(dask: Any, address: str) -> dict[str, Any]:
    """A scheduler's identity; raises TimeoutError without an answer."""
    import asyncio  # noqa: PLC0415 - of no use to a worker

    async def ask() -> dict[str, Any]:
        # The user's certificates, if Dask is configured with any.
        security = dask.Security().get_connection_args("client")
        async with (
            asyncio.timeout(ANSWER_SECONDS),
            dask.rpc(address, connection_args=security) as scheduler,
        ):
            identity = await scheduler.identity()
            return dict(identity)

    return _in_a_thread(lambda: asyncio.run(ask()))


def _in_a_thread(function: Callable[[], Outcome]) -> Outcome:
    """Call a function in a thread of its own: a notebook's has an event loop that runs already."""
    results: list[Outcome] = []
    errors: list[BaseException] = []

    def call() -> None:
        try:
            results.append(function())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return results[0]
