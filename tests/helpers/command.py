"""The command line, here or in a process of its own; waiting for what it does, and for its end."""

import io
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest import mock

import psutil

NOTHING: Mapping[str, str] = {}
LONG_STUDY = """\
schema = 1
name = "long"
scenarios = ["paper"]
evaluation = { seeds = 4000, steps = 1000 }
[[case]]
controller = "naive"
"""
"""A study that nobody waits for, to be interrupted."""


def run_cosim(
    *words: object,
    folder: Path | None = None,
    env: Mapping[str, str] = NOTHING,
    check: bool = False,
    **options: Any,
) -> subprocess.CompletedProcess[str]:
    """Run `cosim` in a folder to its end, with these values added to the environment.

    `options` are further ones of `subprocess.run`.
    """
    return subprocess.run(
        [sys.executable, "-m", "cosim", *map(str, words)],
        cwd=folder,
        env=os.environ | env,
        capture_output=True,
        text=True,
        check=check,
        **options,
    )


def run_here(*words: object) -> subprocess.CompletedProcess[str]:
    """Run `cosim` in this process, which has loaded its packages already."""
    from cosim.cli import main

    arguments = ["cosim", *map(str, words)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with redirect_stdout(out), redirect_stderr(err), mock.patch.object(sys, "argv", arguments):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def start_cosim(
    *words: object, folder: Path | None = None, env: Mapping[str, str] = NOTHING, **options: Any
) -> subprocess.Popen[str]:
    """Start `cosim` in a folder, with a pipe from its standard error."""
    return subprocess.Popen(
        [sys.executable, "-m", "cosim", *map(str, words)],
        cwd=folder,
        env=os.environ | env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


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
