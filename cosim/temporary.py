"""Temporary folders that end with the process that made them, by whatever signal it ends."""

from __future__ import annotations

import atexit
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cosim import caretaker
from cosim.guarded import end_guarded

_lock = threading.Lock()
# The process's caretaker: of this process, not of one that it was forked from.
_caretakers: dict[int, subprocess.Popen[bytes]] = {}


@contextmanager
def temporary_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """A new folder that only this user can enter, deleted at the end of the block.

    Where the process ends before that, the folder is deleted all the same, within seconds, by a
    small process that waits for it. `parent` is where it lies, by default where the system keeps
    temporary files; its name begins with `prefix`. Raises OSError where it cannot be made.
    """
    folder = new_temporary_folder(prefix, parent)
    try:
        yield folder
    finally:
        delete_temporary_folder(folder)


def new_temporary_folder(prefix: str, parent: Path | None = None) -> Path:
    """Make such a folder; it ends with this process or by `delete_temporary_folder`."""
    while True:
        root = Path(tempfile.gettempdir() if parent is None else parent).absolute()
        folder = root / f"{prefix}{secrets.token_hex(4)}"
        # Before it is there: a process that is killed in between leaves nothing either.
        _tell("+", folder)
        try:
            folder.mkdir(mode=0o700)
        except FileExistsError:
            _tell("-", folder)
        except BaseException:
            _tell("-", folder)
            raise
        else:
            return folder


def delete_temporary_folder(folder: Path) -> None:
    """Delete a temporary folder, if it is there still, and think no more of it."""
    shutil.rmtree(folder, ignore_errors=True)
    if not folder.exists():
        _tell("-", folder)


def _tell(sign: str, folder: Path) -> None:
    """Announce a folder to the process's caretaker, or take that back."""
    line = json.dumps([sign, str(folder)]).encode() + b"\n"
    with _lock:
        stream = _caretaker().stdin
        assert stream is not None
        with suppress(OSError):  # somebody has ended it: the folder is deleted by this process only
            stream.write(line)
            stream.flush()


def _caretaker() -> subprocess.Popen[bytes]:
    number = os.getpid()
    if number not in _caretakers:
        # In a session of its own: neither Ctrl-C nor the end of the process group is for it.
        _caretakers[number] = subprocess.Popen(
            [sys.executable, "-I", "-S", caretaker.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=Path(sys.executable).anchor,
            start_new_session=True,
        )
        atexit.register(_dismiss, number)
    return _caretakers[number]


def _dismiss(number: int) -> None:
    if number != os.getpid():
        return
    end_guarded(_caretakers.pop(number))
