"""A command with foreign native code runs in a process of its own, watched by the one called.

An FMU may call `exit(0)`, be killed, or close what the process has open: the process that was
called still knows whether the command came to its end, and says so.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from cosim.cli.locking import hold, release
from cosim.errors import CosimError, PlantError
from cosim.lifetime import Terminated, follow_parent

MARK = "COSIM_FINISHED"
"""Environment variable that names the file by which a watched command says that it has ended."""

# The mark of this process once it is known to be the command line's: a path, or none.
_marks: list[str | None] = []


def enter() -> None:
    """Note that this process is the command line's: one that may be watched, or that is."""
    # Taken out, so that what this command starts does not take itself for it.
    _marks.append(os.environ.pop(MARK, None))
    if _marks[-1] is not None:
        follow_parent()


def finish() -> None:
    """Leave word that the command came to its end, whatever its exit code."""
    mark = _marks.pop()
    if mark is not None:
        with suppress(OSError):
            Path(mark).touch()


def watch(fmu: Path, stdout: int | None) -> None:
    """Run this command again in a process of its own, and exit as that does; else return.

    It returns in that process, and where the command line was not the one called. `stdout` is the
    descriptor of standard output where another is in its place. Raises PlantError where the
    process ended before the command did.
    """
    if not _marks or _marks[-1] is not None:
        return
    from cosim.temporary import temporary_folder  # here: few commands watch another

    flags = subprocess._args_from_interpreter_flags()  # type: ignore[attr-defined]
    command = [sys.executable, *flags, "-m", "cosim", *sys.argv[1:]]
    folders = release()  # for the process that does the work
    with temporary_folder("cosim-") as temporary:
        mark = temporary / "finished"
        child = subprocess.Popen(command, stdout=stdout, env=os.environ | {MARK: str(mark)})
        code = _outcome(child)
        finished = mark.exists()
    if finished and code >= 0:
        sys.exit(code)
    for folder in folders:  # so that the locks of a process that was killed are cleared away
        with suppress(CosimError, OSError):
            hold(folder)
    how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
    raise PlantError(
        f"FMU '{fmu}', or other native code, ended the process {how} before the command finished"
    )


def _outcome(child: subprocess.Popen[bytes]) -> int:
    """The child's exit code; what ends this process meanwhile ends the child first."""
    try:
        return child.wait()
    except KeyboardInterrupt:
        # Ctrl-C reached the child, too: it unwinds.
        child.wait()
        raise
    except Terminated:
        child.terminate()
        child.wait()
        raise
