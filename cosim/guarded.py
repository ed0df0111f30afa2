"""Starts commands that end when the process that started them does, by whatever signal."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from cosim import guardian


def start_guarded(
    command: Sequence[str],
    *,
    env: Mapping[str, str] | None = None,
    log: IO[bytes] | int | None = None,
    folder: Path | None = None,
) -> subprocess.Popen[bytes]:
    """Start a command, and all that it starts, in a group that ends when this process does.

    `env` is its environment, `log` takes what it prints (default: where this process prints).
    The process returned is the guard: its exit code is the command's, and `end_guarded` ends it.
    With `folder` the command runs there, its exit code is `exit_code(folder)`, and the guard waits
    to delete the folder, by `end_guarded` or with this process.
    """
    return subprocess.Popen(
        [sys.executable, "-I", guardian.__file__, str(folder or ""), *command],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        env=dict(env) if env is not None else None,
    )


def end_guarded(process: subprocess.Popen[bytes]) -> None:
    """End a guarded command and wait until it has ended."""
    if process.stdin is not None:
        with suppress(OSError):
            process.stdin.close()
    process.wait()


def exit_code(folder: Path) -> int | None:
    """Exit code of the guarded command that ran in a folder, None where it has not ended."""
    try:
        return int((folder / guardian.EXIT_CODE).read_text())
    except FileNotFoundError:
        return None
