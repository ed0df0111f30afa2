"""Processes and signals: who ends with whom, and where a command prints."""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO

# psutil is imported where it is needed: every command imports this file.


class Terminated(BaseException):
    """SIGTERM or SIGHUP was received; raised so that a command unwinds as it does on Ctrl-C."""


class CtrlC(KeyboardInterrupt):
    """Ctrl-C was pressed.

    Not a plain KeyboardInterrupt: once one has left a text that `exec` runs, as each dataclass
    does, CPython ends the process by SIGINT at its exit, whatever was caught and returned.
    """


class Interrupted(BaseException):
    """Ctrl-C was pressed, and the command has unwound; its arguments say how it goes on."""


unwound = threading.Event()
"""Set while no command runs in this process, and once one has unwound: signals are then ignored."""
unwound.set()
_SIGNALS = [
    getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGINT") if hasattr(signal, name)
]
_repeats: list[threading.Timer] = []
"""Threads that raise a signal once more, a second after it."""


@contextmanager
def command_process() -> Iterator[None]:
    """Run a command so that signals unwind it.

    Ctrl-C raises `CtrlC`, SIGTERM and SIGHUP `Terminated`, once. Signals that the caller ignores,
    as nohup and a shell's background jobs do, stay ignored. Restores the previous handlers; at
    interpreter shutdown the signals are ignored.
    """
    unwound.clear()
    report_ignored = sys.unraisablehook

    def report(ignored: sys.UnraisableHookArgs) -> None:
        # Where Python drops ours, in a weak reference's callback say, it is raised once more.
        if not isinstance(ignored.exc_value, CtrlC | Terminated):
            report_ignored(ignored)

    sys.unraisablehook = report
    defaults = (signal.SIG_DFL, signal.default_int_handler)
    before = {}
    for number in _SIGNALS:
        if signal.getsignal(number) in defaults:
            before[number] = signal.signal(number, _raise)
    try:
        yield
    finally:
        unwound.set()
        # One that is about to raise its signal does so while it is ignored: the caller's handler
        # would end the process by it.
        for timer in _repeats:
            timer.cancel()
            timer.join()
        _repeats.clear()
        for number, handler in before.items():
            signal.signal(number, handler)
            atexit.register(signal.signal, number, signal.SIG_IGN)
        sys.unraisablehook = report_ignored


def _raise(number: int, _: FrameType | None) -> None:
    """Raise the signal's exception, and again after a second in case C code has cleared it."""
    # While one of them unwinds the command, a second signal is ignored.
    unwinding = sys.exception()
    while unwinding is not None and not isinstance(unwinding, KeyboardInterrupt | Terminated):
        unwinding = unwinding.__context__
    if unwound.is_set() or unwinding is not None:
        return

    def again() -> None:
        if unwound.is_set():
            return
        # In a thread: only the process as a whole reaches the main thread.
        if os.name == "nt":
            signal.raise_signal(number)
        else:
            os.kill(os.getpid(), number)

    timer = threading.Timer(1.0, again)
    timer.daemon = True
    timer.start()
    _repeats.append(timer)
    raise CtrlC if number == signal.SIGINT else Terminated


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Block Ctrl-C for the workers that are started here, and for their threads and children.

    On Windows nothing is done.
    """
    if os.name == "nt":
        yield
        return
    from multiprocessing.resource_tracker import ensure_running  # noqa: PLC0415

    # Started later, it would unblock Ctrl-C.
    ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def follow_parent(number: int) -> None:
    """End this worker process at once when its parent, process `number`, has ended.

    The parent may have ended before this call.
    """
    import psutil  # noqa: PLC0415

    def watch() -> None:
        with suppress(psutil.Error):
            psutil.Process(number).wait()
        os._exit(1)

    threading.Thread(target=watch, name="follow-parent", daemon=True).start()


def _die_with_parent() -> None:
    """Ask Linux to kill this process, a child before its command starts, when its parent ends."""
    import ctypes  # noqa: PLC0415

    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


@contextmanager
def child_process(
    command: Sequence[str],
    *,
    folder: Path | None = None,
    env: Mapping[str, str] | None = None,
    log: IO[bytes] | int | None = None,
) -> Iterator[subprocess.Popen[bytes]]:
    """Start a command; end it, and all that it has started, at the end of the block.

    It belongs to this process's group, so that a closed terminal, say, ends both; on Linux a kill
    of this process alone ends it as well.

    Args:
        command: its words.
        folder: its working directory, which holds its temporary files.
        env: its environment.
        log: takes its output.

    Raises:
        OSError: it cannot be started.
    """
    environment = dict(os.environ if env is None else env)
    if folder is not None:
        # Whichever of them the command's platform reads.
        for variable in ("TMPDIR", "TEMP", "TMP"):
            environment[variable] = str(folder)
    child = subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=None if log is None else subprocess.STDOUT,
        preexec_fn=_die_with_parent if sys.platform == "linux" else None,  # noqa: PLW1509
    )
    try:
        yield child
    finally:
        _end(child)


def processor_seconds(process_id: int) -> float:
    """Seconds of the processor that a process and its descendants have taken, 0 once it is gone.

    Args:
        process_id: of the process.
    """
    import psutil  # noqa: PLC0415

    total = 0.0
    try:
        process = psutil.Process(process_id)
        for one in (process, *process.children(recursive=True)):
            # What a child took that has ended is its parent's, where the system counts it.
            with suppress(psutil.NoSuchProcess):
                total += sum(one.cpu_times()[:4])
    except psutil.NoSuchProcess:
        return 0.0
    return total


def _end(child: subprocess.Popen[bytes]) -> None:
    """Terminate a child and its descendants; kill them after two seconds."""
    import psutil  # noqa: PLC0415

    with suppress(psutil.NoSuchProcess):
        parent = psutil.Process(child.pid)
        family = [parent, *parent.children(recursive=True)]
        # A request first: a process may have files of its own to remove.
        for end in (psutil.Process.terminate, psutil.Process.kill):
            for process in family:
                with suppress(psutil.Error):
                    end(process)
            _, family = psutil.wait_procs(family, 2.0)
    # Reaped here, so that no zombie stays.
    child.wait()


@contextmanager
def redirected_output() -> Iterator[int | None]:
    """Redirect standard output, of native code too, to standard error.

    Yields:
        The descriptor of the true standard output; None where standard output is not this
        process's own, as in a test runner.
    """
    is_ours = sys.stdout is sys.__stdout__
    if not is_ours:
        yield None
        return
    # What was printed before belongs where it was going.
    sys.stdout.flush()
    # By descriptor: native code does not know Python's `sys.stdout`.
    descriptor = os.dup(1)
    os.dup2(2, 1)
    try:
        yield descriptor
    finally:
        sys.stdout.flush()
        os.dup2(descriptor, 1)
        os.close(descriptor)
