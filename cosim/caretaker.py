"""Deletes the temporary folders that a process had when it ended, by whatever signal.

A program of its own, run by its path with nothing but the standard library, so that it starts in
some milliseconds. Each line on standard input is a JSON list: `["+", PATH]` announces a folder,
`["-", PATH]` takes that back. The process that writes them holds the pipe open; whatever ends it
closes the pipe, even a SIGKILL, and what is announced by then is deleted.
"""

import json
import os
import shutil
import sys
import time
from collections.abc import Iterable

TRIES, PAUSE = 100, 0.1
"""How often, and after how many seconds, a folder is tried in which somebody still writes."""


def announced(lines: Iterable[bytes]) -> set[str]:
    """Folders that the lines announce and do not take back; the last line may be torn."""
    folders: set[str] = set()
    for line in lines:
        if not line.endswith(b"\n"):
            break
        sign, path = json.loads(line)
        (folders.add if sign == "+" else folders.discard)(path)
    return folders


def delete(folders: set[str]) -> None:
    """Delete folders and what is in them."""
    for _ in range(TRIES):
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)
        if not any(map(os.path.lexists, folders)):
            return
        time.sleep(PAUSE)


if __name__ == "__main__":
    delete(announced(sys.stdin.buffer))
