"""Kills only the parent of commands that start others, at random moments, and looks for survivors.

    python tests/faults/orphans.py --trials 70

Every trial: start the command in a folder of its own for results, cache and temporary files, end
its first process alone (SIGKILL or SIGTERM, in turn) after a random share of the command's own
time, and wait until the last process that it had started has ended. Nothing of it may be left
then: no process, semaphore, socket, temporary file or unfinished entry of the cache, and nobody may
hold the folder. The command is run again and must end as it does undisturbed. Prints what was seen
as JSON, in seconds for what took time; ends in an AssertionError where something was left.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import filelock

from cosim.cli.locking import HOLDER, LOCK

MARK = "COSIM_ORPHANS"
COSIM = (sys.executable, "-m", "cosim")
ROOT = Path(__file__).parents[2]
PATIENCE = 60.0
"""Seconds within which everything must have ended; a loaded machine's guard polls in its time."""
STUDY = """\
schema = 1
name = "orphans"
scenarios = ["paper"]
training_seeds = { first = 0, count = 2 }
evaluation = { seeds = 4, steps = 1000 }
curves = { points = 3, seeds = 2, steps = 200 }
[[case]]
controller = "tuned"
[[case]]
name = "q"
algorithm = "q-learning"
samples = 3000
"""


def _nothing(folder: Path) -> None:
    pass


def _recording(folder: Path) -> None:
    run(["simulate", "-n", "300", "--record", "--out", "recorded"], folder)


def _study(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY)


@dataclass(frozen=True)
class Job:
    """A command, what it needs beforehand, what it must have written, and how it goes on."""

    name: str
    words: str
    result: str
    begin: Callable[[Path], None] = _nothing
    again: str = ""


JOBS = (
    Job("simulate --record", "simulate -n 6000 --record --out out", "out/summary.json"),
    Job("simulate --isolate", "simulate -n 3000 --isolate --out out", "out/summary.json"),
    Job(
        "train",
        "train -a q-learning -n 4000 --checkpoint-every 1000 --out out",
        "out/summary.json",
        again="--overwrite",
    ),
    Job("evaluate --jobs", "evaluate --seeds 6 -n 2500 --jobs 2 --out out", "out/summary.json"),
    Job("study --jobs", "study run study.toml --jobs 2 --out out", "out/summary.json", _study),
    Job("view --png", "view recorded/run.rrd --png out.png", "out.png", _recording),
    Job("export", "export tuned --out out/policy.fmu", "out/policy.fmu"),
)


def environment(folder: Path) -> dict[str, str]:
    """One in which all that a command leaves is in the folder, and its processes are known."""
    own = {"TMPDIR": folder / "temporary", "COSIM_CACHE": folder / "cache", MARK: folder}
    return os.environ | {name: str(value) for name, value in own.items()}


def start(words: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start a command in a folder."""
    (folder / "temporary").mkdir(exist_ok=True)
    return subprocess.Popen(
        [*COSIM, *words],
        cwd=folder,
        env=environment(folder) | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def run(words: list[str], folder: Path) -> None:
    """Run a command to its end; raises AssertionError with its last words where it failed."""
    process = start(words, folder)
    _, said = process.communicate()
    assert process.returncode == 0, f"{words}: exit code {process.returncode}\n{said.decode()}"


def family(folder: Path) -> dict[int, str]:
    """Processes that a command in the folder has started and that run still, by number."""
    mark, found = f"{MARK}={folder}".encode(), {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            if mark not in (place / "environ").read_bytes().split(b"\0"):
                continue
            state = (place / "stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z":
                found[int(place.name)] = (place / "cmdline").read_text().replace("\0", " ")
        except (OSError, UnicodeDecodeError):
            continue
    return found


def survive(folder: Path, began: float) -> float:
    """Seconds until the last process has ended; raises AssertionError where one stays."""
    while left := family(folder):
        lasted = time.monotonic() - began
        assert lasted < PATIENCE, f"after {lasted:.1f} s these still run: {left}"
        time.sleep(0.02)
    return time.monotonic() - began


def leftovers(folder: Path, numbers: set[int]) -> list[str]:
    """What a killed command has left where nothing may be left."""
    found = [str(path) for path in (folder / "temporary").rglob("*")]
    found += [str(path) for path in (folder / "cache").glob("*/.partial-*")]
    shared = Path("/dev/shm")
    if shared.is_dir():
        marks = [f"-{number}-" for number in numbers]
        found += [p.name for p in shared.iterdir() if any(mark in p.name for mark in marks)]
    sockets = Path("/proc/net/unix").read_text().splitlines()
    found += [line for line in sockets if str(folder) in line]
    for path in folder.rglob("*.lock"):
        lock = filelock.FileLock(path, blocking=False)
        try:
            lock.acquire()
        except filelock.Timeout:
            found.append(f"{path} is held")
        else:
            lock.release()
    return found


def trial(job: Job, folder: Path, delay: float, number: signal.Signals) -> dict[str, float]:
    """Kill a job's first process once, look, and run it again; what was seen."""
    job.begin(folder)
    process = start(job.words.split(), folder)
    time.sleep(delay)
    members = family(folder)
    running = process.poll() is None
    began = time.monotonic()
    if running:
        process.send_signal(number)
    # Not `communicate`: what survives the parent would hold its pipe.
    code = process.wait(PATIENCE)
    ended = survive(folder, began)
    assert process.stderr is not None
    with process.stderr as stream:
        said = stream.read().decode()
    what = f"{job.name}, {number.name} at {delay:.2f} s"
    assert "Traceback" not in said, f"{what}:\n{said}"
    if running:
        # A signal before Python has begun to handle it ends the process as the system does.
        expected = {0, -number} | ({143} if number == signal.SIGTERM else set())
        assert code in expected, f"{what}: exit code {code}\n{said}"
    left = leftovers(folder, set(members))
    assert not left, f"{what} left {left}"
    resumed = [*job.words.split(), *(job.again.split() if (folder / "out").exists() else [])]
    run(resumed, folder)
    assert (folder / job.result).is_file()
    locks = [path for path in folder.rglob("*") if path.name in {LOCK, HOLDER}]
    assert not locks, f"{what}, then run again, left {locks}"
    return {"killed": running, "others": max(0, len(members) - 1), "seconds": ended}


def campaign(trials: int, seed: int, names: tuple[str, ...] = ()) -> dict[str, dict[str, float]]:
    """Run trials in turn over the jobs; what was seen, by job."""
    draw = random.Random(seed)
    jobs = [job for job in JOBS if not names or job.name in names]
    counts: dict[str, Counter[str]] = {job.name: Counter() for job in jobs}
    slowest = dict.fromkeys(counts, 0.0)
    durations: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="cosim-orphans-") as top:
        for number in range(trials):
            job = jobs[number % len(jobs)]
            folder = Path(top) / str(number)
            folder.mkdir()
            if job.name not in durations:
                job.begin(folder)
                began = time.monotonic()
                run(job.words.split(), folder)
                durations[job.name] = time.monotonic() - began
                assert not (left := leftovers(folder, set())), f"{job.name} left {left}"
                shutil.rmtree(folder)
                folder.mkdir()
            # The first tenth is Python's start.
            delay = draw.uniform(0.1, 1.0) * durations[job.name]
            kind = (signal.SIGKILL, signal.SIGTERM)[number // len(jobs) % 2]
            seen = trial(job, folder, delay, kind)
            counts[job.name]["trials"] += 1
            counts[job.name]["killed while running"] += int(seen["killed"])
            counts[job.name]["with others running"] += int(seen["others"] > 0)
            slowest[job.name] = max(slowest[job.name], seen["seconds"])
            words = f"trial {number + 1}: {job.name}, {kind.name} at {delay:.2f} s"
            print(f"{words}, all ended after {seen['seconds']:.2f} s", file=sys.stderr)
            shutil.rmtree(folder)
    return {
        name: {**counter, "seconds until all had ended, at most": round(slowest[name], 2)}
        for name, counter in counts.items()
    }


def main() -> None:
    """Run the campaign and print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=70)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", default=[], choices=[job.name for job in JOBS])
    options = parser.parse_args()
    seen = campaign(options.trials, options.seed, tuple(options.only))
    print(json.dumps(seen, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
