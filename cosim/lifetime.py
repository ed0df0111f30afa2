"""Ends what a command started when the command itself ends, by whatever signal."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from types import FrameType

# Every command imports this file; processes are imported where one is started.

POLL = 0.5
"""Seconds between two looks at the parent where nothing announces its end."""


AGAIN = 1.0
"""Seconds after which a SIGTERM whose exception was lost comes again."""


class Terminated(BaseException):
    """SIGTERM was received; raised so that a command unwinds as it does on Ctrl-C."""


class Interrupted(BaseException):
    """Ctrl-C was pressed, and the command has unwound; its arguments say how it goes on."""


def unwind_on_sigterm() -> None:
    """Let SIGTERM raise `Terminated` in this process's main thread, until that has unwound.

    An exception out of a signal handler is lost where C code clears errors that it did not expect,
    in an import for instance; so the signal comes again until the exception is on its way.
    """

    def terminate(number: int, frame: FrameType | None) -> None:
        again = threading.Timer(AGAIN, signal.raise_signal, [signal.SIGTERM])
        again.daemon = True
        again.start()
        if not isinstance(sys.exc_info()[1], Terminated):
            raise Terminated

    signal.signal(signal.SIGTERM, terminate)


def ignore_sigterm() -> None:
    """Take no more notice of SIGTERM: the process is ending."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


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
