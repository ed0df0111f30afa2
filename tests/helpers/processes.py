"""Whether processes run, and waiting for what comes."""

import time

import psutil


def alive(number):
    """Whether a process runs; a dead one that nobody waits for counts as ended."""
    try:
        return psutil.Process(int(number)).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def eventually(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.05)
    return False
