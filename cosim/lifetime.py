"""Ends what a command started when the command itself ends, by whatever signal."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# Every command imports this file; processes are imported where one is started.

POLL = 0.5
"""Seconds between two looks at the parent where nothing announces its end."""


AGAIN = 1.0
"""Seconds after which a signal whose exception was lost comes again."""

_unwound = threading.Event()


class Terminated(BaseException):
    """SIGTERM was received; raised so that a command unwinds as it does on Ctrl-C."""


class Interrupted(BaseException):
    """Ctrl-C was pressed, and the command has unwound; its arguments say how it goes on."""


@contextmanager
def unwinding_on_signals() -> Iterator[None]:
    """Let SIGTERM raise `Terminated` and Ctrl-C KeyboardInterrupt, until the command has unwound.

    An exception out of a signal handler is lost where C code clears errors that it did not expect,
    in an import for instance; so the signal comes again until the exception is on its way, or
    `unwound` says that it has arrived. A Ctrl-C that is ignored, as a shell's background jobs
    ignore it, stays so. Afterwards the handlers are those of before, and when the interpreter ends,
    where an exception is nobody's any more, none.
    """
    _unwound.clear()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    signal.signal(signal.SIGTERM, _raising(signal.SIGTERM, Terminated))
    if before[signal.SIGINT] is signal.default_int_handler:
        signal.signal(signal.SIGINT, _raising(signal.SIGINT, KeyboardInterrupt))
    try:
        yield
    finally:
        unwound()
        atexit.register(_ignore)
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def unwound() -> None:
    """Take no more notice of SIGTERM and Ctrl-C: the command has unwound."""
    _unwound.set()


def _ignore() -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


def _raising(
    number: signal.Signals, error: type[BaseException]
) -> Callable[[int, FrameType | None], None]:
    """Handler that raises an error and, after `AGAIN` seconds, sends the signal once more."""
    own = False

    def send_again() -> None:
        nonlocal own
        if _unwound.is_set():
            return
        own = True
        if os.name == "nt":
            signal.raise_signal(number)
        else:  # to the process, so that the main thread is woken out of a wait
            os.kill(os.getpid(), number)

    def handle(_: int, frame: FrameType | None) -> None:
        nonlocal own
        if _unwound.is_set():
            return
        again, own = own, False
        timer = threading.Timer(AGAIN, send_again)
        timer.daemon = True
        timer.start()
        # A second Ctrl-C of the user's may end an unwinding that hangs; a process that is watched
        # gets SIGTERM from its group and from its parent.
        if _on_its_way(error) and (again or number == signal.SIGTERM):
            return
        raise error

    return handle


def _on_its_way(error: type[BaseException]) -> bool:
    """Whether such an exception is being handled, or what is arose in handling one."""
    found = sys.exc_info()[1]
    while found is not None and not isinstance(found, error):
        found = found.__context__
    return found is not None


@contextmanager
def out_of_reach_of_ctrl_c() -> Iterator[None]:
    """Start a process here that Ctrl-C in the terminal does not reach: its parent decides.

    Its threads and its children inherit that. On Windows nothing is done.
    """
    if os.name == "nt":
        yield
        return
    from multiprocessing.resource_tracker import ensure_running  # noqa: PLC0415

    ensure_running()  # it would be started first, and let Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def follow_parent(number: int | None = None) -> None:
    """End this worker process, without further ado, as soon as the process that started it ends.

    To be called once in a worker, whose work is lost with its parent anyway. `number` is the
    parent's, which may have ended before the worker could ask for it.
    """
    from multiprocessing import parent_process  # noqa: PLC0415
    from multiprocessing.connection import wait  # noqa: PLC0415

    parent = parent_process()
    sentinel = None if parent is None else parent.sentinel
    if number is None or os.name == "nt":  # where a launcher may stand between the two
        number = os.getppid()

    def watch() -> None:
        if sentinel is not None:
            wait([sentinel])
        else:
            while os.getppid() == number:
                time.sleep(POLL)
        os._exit(1)

    threading.Thread(target=watch, name="follow-parent", daemon=True).start()
