"""Whether processes run, found in /proc."""

import time
from pathlib import Path


def alive(number):
    """Whether a process runs; a dead one that nobody waits for counts as ended."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def running(mark):
    """Numbers of the processes whose command line has a mark."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "cmdline").read_bytes() and alive(folder.name):
                found.append(folder.name)
        except OSError:
            continue
    return found


def eventually(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.05)
    return False
