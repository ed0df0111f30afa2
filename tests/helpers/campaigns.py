"""Commands that are interrupted at random moments, over and over, in folders of their own."""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from tests.helpers.command import start_cosim

ROOT = Path(__file__).parents[2]
PACKAGES = ("fmus", "cosim", "controllers", "learning")
EMPTY: Mapping[str, str] = {}


class Job(Protocol):
    """A command that is interrupted."""

    @property
    def name(self) -> str:
        """What reports call it."""

    @property
    def begin(self) -> Callable[[Path], None]:
        """Makes in a folder what the command needs."""


J = TypeVar("J", bound=Job)


@dataclass(frozen=True)
class Trial(Generic[J]):
    """Interrupt a job in `folder`, begun already, after `delay` seconds.

    `reference` is a folder in which it ran undisturbed.
    """

    number: int
    job: J
    folder: Path
    reference: Path
    delay: float


def trials(
    jobs: Sequence[J],
    count: int,
    seed: int,
    whole: Callable[[J, Path], None],
    *,
    seconds: float = float("inf"),
) -> Iterator[Trial[J]]:
    """Trials over the jobs in turn, for a time, each at a random share of its job's own.

    `whole` runs a job to its end, which is timed before its first trial.
    """
    end, draw = time.monotonic() + seconds, random.Random(seed)
    durations: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="cosim-trials-") as top:
        # A copy: work that goes on in the checkout must not change the program under the trials.
        for package in PACKAGES:
            shutil.copytree(ROOT / package, Path(top) / "code" / package)
        for number in range(count):
            if time.monotonic() > end:
                return
            job = jobs[number % len(jobs)]
            # Short names: a socket's path has 107 bytes.
            reference = Path(top) / f"whole-{number % len(jobs)}"
            if job.name not in durations:
                reference.mkdir()
                job.begin(reference)
                began = time.monotonic()
                whole(job, reference)
                durations[job.name] = time.monotonic() - began
            folder = Path(top) / str(number)
            folder.mkdir()
            job.begin(folder)
            # The first tenth is Python's start.
            delay = draw.uniform(0.1, 1.0) * durations[job.name]
            yield Trial(number, job, folder, reference, delay)
            shutil.rmtree(folder)


def start(
    words: Sequence[str], folder: Path, more: Mapping[str, str] = EMPTY, *, group: bool = False
) -> subprocess.Popen[str]:
    """Start `cosim` in a trial's folder, in an environment of `more`, in a process `group`."""
    code = {"PYTHONPATH": str(folder.parent / "code")}
    return start_cosim(*words, folder=folder, env=code | dict(more), start_new_session=group)


def finish(process: subprocess.Popen[str], what: str) -> None:
    """Wait for a command; raises AssertionError with its last words where it failed."""
    _, said = process.communicate()
    assert process.returncode == 0, f"{what}: exit code {process.returncode}\n{said}"


def main(
    about: str,
    jobs: Sequence[Job],
    campaign: Callable[[int, int, tuple[str, ...], float], dict[str, Any]],
    count: int,
) -> None:
    """Run a campaign as the command line says and print what was seen."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--trials", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after")
    parser.add_argument("--only", action="append", default=[], choices=[job.name for job in jobs])
    options = parser.parse_args()
    seen = campaign(options.trials, options.seed, tuple(options.only), options.seconds)
    print(json.dumps(seen, indent=1, ensure_ascii=False))
