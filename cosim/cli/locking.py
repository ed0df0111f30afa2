"""One writer per folder: a command holds the folder that it writes to until it has ended."""

from __future__ import annotations

import json
import os
import socket
import sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.errors import CosimError

if TYPE_CHECKING:
    import filelock

LOCK = ".cosim.lock"
HOLDER = ".cosim.lock.json"
_held: dict[Path, filelock.BaseFileLock] = {}


def hold(folder: Path) -> None:
    """Take a folder's lock until `release`; this process may take it again.

    The system gives the lock back when the process ends, however it ends. Raises CosimError that
    says who holds it, since when, and what to do, and OSError where the folder cannot be written.
    """
    import filelock  # here, with some fifty modules that `cosim --help` has no use for

    folder = folder.resolve()
    if folder in _held:
        return
    lock = filelock.FileLock(folder / LOCK, blocking=False)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise CosimError(f"{_holder(folder)}; wait for it or choose another --out") from None
    _held[folder] = lock
    holder = {
        "command": " ".join(["cosim", *sys.argv[1:]]),
        "process": os.getpid(),
        "machine": socket.gethostname(),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    (folder / HOLDER).write_text(json.dumps(holder), "utf-8")


def release() -> list[Path]:
    """Give back every lock that this process holds, and leave no trace of them; the folders."""
    folders = list(_held)
    while _held:
        folder, lock = _held.popitem()
        # Removed while it is held: whoever opens it meanwhile finds it gone and makes another.
        for name in (HOLDER, LOCK):
            with suppress(OSError):
                (folder / name).unlink()
        lock.release()
    return folders


def _holder(folder: Path) -> str:
    try:
        found = json.loads((folder / HOLDER).read_text("utf-8"))
        who = (
            f"process {found['process']} on {found['machine']} ({found['command']}) since "
            f"{found['since']}"
        )
    except (OSError, ValueError, KeyError, TypeError):
        who = "another process"
    return f"folder '{folder}' is being written by {who}"
