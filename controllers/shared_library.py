"""Shared libraries that the machine's own C compiler makes of a source, whole or not at all."""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cosim.files import is_trusted
from cosim.guarded import end_guarded, exit_code, start_guarded

if TYPE_CHECKING:
    import filelock

FLAGS = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")
WAIT = 0.01
"""Seconds between two looks at a compiler that is waited for."""


class Compiler(NamedTuple):
    """A C compiler: its `path`, and its `identity`, one line that tells it from others."""

    path: str
    identity: str


@cache
def find_compiler(chosen: str | None = None) -> Compiler | None:
    """The compiler `chosen`, else the first of cc, gcc and clang; None where there is none."""
    for name in [chosen] if chosen else ["cc", "gcc", "clang"]:
        found = shutil.which(name)
        if found is None or (sys.platform == "darwin" and not _has_command_line_tools()):
            continue
        path = Path(found).resolve()
        status = path.stat()
        identity = f"{path} {status.st_size} {status.st_mtime_ns} {platform.machine()}"
        return Compiler(found, identity)
    return None


def _has_command_line_tools() -> bool:
    """Whether macOS has a compiler behind its `cc`, which else asks the user to install one."""
    answer = subprocess.run(["xcode-select", "-p"], capture_output=True, check=False)
    return answer.returncode == 0


def lock_of(name: str, folder: Path, *, wait: bool = False) -> filelock.BaseFileLock | None:
    """The lock of a library that is being built, held; None where another process holds it."""
    import filelock  # noqa: PLC0415 (short runs, which compile nothing, shall not pay for it)

    lock = filelock.FileLock(folder / f"{name}.lock", blocking=wait)
    try:
        lock.acquire()
    except filelock.Timeout:
        return None
    return lock


class Build:
    """A compiler at work on a source, in a folder of its own; the lock keeps others from it."""

    def __init__(
        self, compiler: Compiler, source: str, name: str, folder: Path, lock: filelock.BaseFileLock
    ) -> None:
        self._name, self._folder, self._lock = name, folder, lock
        try:
            self._own = Path(tempfile.mkdtemp(prefix=".partial-", dir=folder))
            (self._own / "functions.c").write_text(source, encoding="utf-8")
            command = [compiler.path, *FLAGS, "-o", "library", "functions.c", "-lm"]
            self._process = start_guarded(command, log=subprocess.DEVNULL, folder=self._own)
        except BaseException:
            self._lock.release()
            raise
        atexit.register(self.close)

    def done(self, *, wait: bool = False) -> bool:
        """Whether the compiler has ended."""
        while (ended := self._ended()) is None and wait:
            time.sleep(WAIT)
        return ended is not None

    def _ended(self) -> int | None:
        """The compiler's exit code, None while it works; the guard's where that was ended."""
        code = exit_code(self._own)
        return self._process.poll() if code is None else code

    def publish(self) -> Path | None:
        """Put the library in its place, whole; None where the compiler failed."""
        try:
            if self._ended():
                return None
            made = self._own / "library"
            made.chmod(0o700)
            content = made.read_bytes()
            path = self._folder / f"{self._name}.{hashlib.sha256(content).hexdigest()}"
            made.replace(path)
            return path
        except OSError:
            return None
        finally:
            self.close()

    def close(self) -> None:
        """End the compiler and leave nothing behind."""
        end_guarded(self._process)
        shutil.rmtree(self._own, ignore_errors=True)
        self._lock.release()
        atexit.unregister(self.close)


def find(name: str, folder: Path) -> Path | None:
    """The stored library of this name whose bytes are those that were stored, or None."""
    for path in sorted(folder.glob(f"{name}.*")):
        if path.suffix == ".lock":
            continue
        with suppress(OSError):
            content = path.read_bytes() if is_trusted(path) else b""
            if hashlib.sha256(content).hexdigest() == path.suffix[1:]:
                os.utime(path)
                return path
    return None
