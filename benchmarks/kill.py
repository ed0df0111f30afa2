"""Signals at random moments of every long command: nothing is lost, nothing survives.

    python -m benchmarks.kill --trials 70 [--seed 0] [--only training]

Every trial: start the command in a folder of its own, and after a random share of the time that it
takes kill its whole group, kill its first process alone, or send that SIGTERM or Ctrl-C, in turn.
Every process that it had started must end, nobody may hold the folder, every file must be whole,
and the command, run again, must end with the bytes of the run that nobody disturbed. Prints what
happened as JSON; ends in an AssertionError with the first trial that did not hold.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cosim.core.files import HOLDER, LOCK, hold, read_arrays, release
from cosim.recording import read_recording
from tests.helpers.command import alive, eventually, run_cosim, start_cosim

ROOT = Path(__file__).parents[1]
MARK = "COSIM_KILL"
STUDY = """\
schema = 1
name = "runs"
scenarios = ["paper"]
training_seeds = { first = 0, count = 2 }
evaluation = { seeds = 4, steps = 100 }
curves = { points = 2, seeds = 1, steps = 100 }
[[case]]
controller = "tuned"
[[case]]
name = "q"
algorithm = "q-learning"
samples = 1000
"""
WAYS = ("kill the group", "kill the parent", "SIGTERM", "Ctrl-C")


def _nothing(folder: Path) -> None:
    pass


def _study(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY)


def _stored(folder: Path) -> None:
    (folder / "out").mkdir()
    shutil.copy(ROOT / "results" / "tolerances.toml", folder / "out")
    (folder / "out" / "runs.toml").write_text(STUDY)


def _recording(folder: Path) -> None:
    done = run_cosim("simulate", "-n", 300, "--record", "--out", "recorded", folder=folder)
    assert done.returncode == 0, done.stderr


@dataclass(frozen=True)
class Job:
    """A command, the files whose bytes must repeat, what it needs before, how it goes on."""

    name: str
    words: str
    results: tuple[str, ...]
    begin: Callable[[Path], None] = _nothing
    again: str = ""
    """Appended where a checkpoint is there."""


JOBS = (
    Job(
        "training",
        "train -a batch-q-learning -n 3000 --log-every 100 --checkpoint-every 100 --out out",
        ("out/learning.csv", "out/parameters.toml"),
        again=" --resume",
    ),
    Job(
        "evaluation",
        "evaluate --seeds 8 --steps 2000 --jobs 2 --out out --overwrite",
        ("out/evaluation.csv",),
    ),
    Job("study", "study run study.toml --jobs 2 --out out", ("out/summary.csv",), _study),
    Job(
        "recording",
        "simulate --steps 20000 --record --out out --overwrite",
        ("out/trajectory.csv", "out/scenario.toml"),
    ),
    Job(
        "demo",
        "demo --samples 1000 --steps 20 --out out --overwrite",
        ("out/evaluation.csv", "out/learning.csv", "out/parameters.toml"),
    ),
    Job("update", "results update --results out --jobs 2", ("out/runs/summary.csv",), _stored),
    Job("view", "view recorded/run.rrd --png out.png", (), _recording),
    Job("export", "export tuned --out policy.fmu", ("policy.fmu",)),
)


def words(job: Job, folder: Path) -> list[str]:
    """The command, resumed where there is what it can resume."""
    resumable = (folder / "out" / "checkpoint.npz").exists()
    return (job.words + (job.again if resumable else "")).split()


def environment(folder: Path) -> dict[str, str]:
    """Keep all that a command leaves in the folder, and mark its processes."""
    (folder / "tmp").mkdir(exist_ok=True)
    own = {"TMPDIR": folder / "tmp", "COSIM_CACHE": folder / "cache", MARK: folder}
    return {name: str(value) for name, value in own.items()} | {"PYTHONPATH": str(ROOT)}


def family(folder: Path) -> list[str]:
    """Numbers of the processes that the command in a folder has started and that still run."""
    mark, found = f"{MARK}={folder}".encode(), []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (place / "environ").read_bytes().split(b"\0") and alive(place.name):
                found.append(place.name)
        except OSError:
            continue
    return found


def inspect(folder: Path) -> int:
    """How many files there are, hidden ones apart; each is whole, and nobody holds the folder."""
    count = 0
    for path in (folder / "out").rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if hidden or not path.is_file():
            continue
        count += 1
        if path.suffix == ".csv":
            with path.open(newline="") as stream:
                assert len({len(row) for row in csv.reader(stream)}) <= 1, path
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".toml":
            tomllib.loads(path.read_text())
        elif path.suffix == ".npz":
            read_arrays(path)
        elif path.suffix == ".rrd":
            read_recording(path)
    if (folder / "out").is_dir():
        hold(folder / "out")
        release()
    return count


def trial(job: Job, way: str, delay: float, folder: Path, reference: Path) -> Counter[str]:
    """Disturb a job once, look, finish it, compare; what was seen."""
    folder.mkdir()
    job.begin(folder)
    process = start_cosim(
        *words(job, folder), folder=folder, env=environment(folder), start_new_session=True
    )
    time.sleep(delay)
    running = process.poll() is None
    if running and way == "kill the group":
        os.killpg(process.pid, signal.SIGKILL)
    elif running and way == "Ctrl-C":
        os.killpg(process.pid, signal.SIGINT)
    elif running:
        process.send_signal(signal.SIGKILL if way == "kill the parent" else signal.SIGTERM)
    code = process.wait(60.0)
    what = f"{job.name}, {way} after {delay:.2f} s"
    assert eventually(lambda: not family(folder), 60.0), f"{what}: {family(folder)} still run"
    said = process.stderr.read()
    process.stderr.close()
    assert "Traceback" not in said, f"{what}:\n{said}"
    # A signal before Python has begun to handle it ends the process as the system does.
    expected = {"SIGTERM": {143, -15}, "Ctrl-C": {130, -2}}.get(way, {-9})
    assert code in ({0} | expected), f"{what}: exit code {code}\n{said}"
    found = inspect(folder)
    done = run_cosim(*words(job, folder), folder=folder, env=environment(folder))
    assert done.returncode == 0, f"{what}, then again: {done.stderr}"
    for name in job.results:
        assert (folder / name).read_bytes() == (reference / name).read_bytes(), f"{what}: {name}"
    left = [path for path in folder.rglob("*") if path.name in {LOCK, HOLDER}]
    assert not left, f"{what}, then again, left {left}"
    return Counter({"trials": 1, "disturbed": int(running), "whole files found": found})


def campaign(count: int, seed: int, names: tuple[str, ...] = ()) -> dict[str, Counter[str]]:
    """Run trials in turn over the jobs and the ways; what was seen, by job."""
    jobs = [job for job in JOBS if not names or job.name in names]
    seen = {job.name: Counter[str]() for job in jobs}
    draw, durations = random.Random(seed), dict[str, float]()
    with tempfile.TemporaryDirectory(prefix="kill-") as top:
        for number in range(count):
            job, way = jobs[number % len(jobs)], WAYS[number // len(jobs) % len(WAYS)]
            reference = Path(top) / job.name
            if job.name not in durations:
                reference.mkdir()
                job.begin(reference)
                began = time.monotonic()
                done = run_cosim(*job.words.split(), folder=reference, env=environment(reference))
                assert done.returncode == 0, done.stderr
                durations[job.name] = time.monotonic() - began
            delay = draw.uniform(0.05, 1.0) * durations[job.name]
            folder = Path(top) / str(number)  # short: a socket's path has 107 bytes
            seen[job.name] += trial(job, way, delay, folder, reference)
            print(f"trial {number + 1}: {job.name}, {way} after {delay:.2f} s", file=sys.stderr)
            shutil.rmtree(folder)
    return seen


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=70)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", default=[], choices=[job.name for job in JOBS])
    options = parser.parse_args()
    print(json.dumps(campaign(options.trials, options.seed, tuple(options.only)), indent=1))
