"""Kills only the parent of commands that start others, at random moments, and looks for survivors.

    python -m tests.faults.orphans --trials 70

Every trial: start the command in a folder of its own for results, cache and temporary files, end
its first process alone (SIGKILL or SIGTERM, in turn) after a random share of the command's own
time, and wait until the last process that it had started has ended. Nothing of it may be left
then: no process, semaphore, socket, temporary file or unfinished entry of the cache, and nobody may
hold the folder. The command is run again and must end as it does undisturbed. Prints what was seen
as JSON, in seconds for what took time; ends, after the last trial, in an AssertionError where
something was left.
"""

from __future__ import annotations

import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import filelock

from cosim.processes import HOLDER, LOCK
from tests.helpers.campaigns import Trial, finish, main, start, trials

MARK = "COSIM_ORPHANS"
PATIENCE = 60.0
"""Seconds within which everything must have ended; a loaded machine's guard polls in its time."""
STUDY = """\
schema = 1
name = "orphans"
scenarios = ["paper"]
training_seeds = { first = 0, count = 2 }
evaluation = { seeds = 4, steps = 200 }
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
    whole(["simulate", "-n", "300", "--record", "--out", "recorded"], folder)


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


# Training and study go on for longer than the samples after which functions are compiled.
JOBS = (
    Job("simulate --record", "simulate -n 1500 --record --out out", "out/summary.json"),
    Job(
        "train",
        "train -a q-learning -n 3000 --checkpoint-every 1000 --out out",
        "out/summary.json",
        again="--overwrite",
    ),
    Job("evaluate --jobs", "evaluate --seeds 12 -n 150 --jobs 2 --out out", "out/summary.json"),
    Job("study --jobs", "study run study.toml --jobs 2 --out out", "out/summary.json", _study),
    Job("study --jobs 1", "study run study.toml --jobs 1 --out out", "out/summary.json", _study),
    Job("view --png", "view recorded/run.rrd --png out.png", "out.png", _recording),
    Job("export", "export tuned --out policy.fmu", "policy.fmu"),
)


def environment(folder: Path) -> dict[str, str]:
    """What makes a command leave all that it leaves in the folder, and its processes known."""
    own = {"TMPDIR": folder / "temporary", "COSIM_CACHE": folder / "cache", MARK: folder}
    own["TMPDIR"].mkdir(exist_ok=True)
    return {name: str(value) for name, value in own.items()}


def whole(words: list[str], folder: Path) -> None:
    """Run a command to its end; raises AssertionError with its last words where it failed."""
    finish(start(words, folder, environment(folder)), " ".join(words))


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


def shared_memory() -> set[str]:
    """Names of semaphores and other shared memory, of whichever process."""
    place = Path("/dev/shm")
    return {path.name for path in place.iterdir()} if place.is_dir() else set()


def leftovers(folder: Path, numbers: set[int], before: set[str]) -> list[str]:
    """What a killed command has left where nothing may be left.

    Of shared memory that was not there `before`: an older process may have had the same number.
    """
    found = [str(path) for path in (folder / "temporary").rglob("*")]
    found += [str(path) for path in (folder / "cache").glob("*/.partial-*")]
    marks = [f"-{number}-" for number in numbers]
    found += [s for s in shared_memory() - before if any(mark in s for mark in marks)]
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


def trial(one: Trial[Job], number: signal.Signals) -> dict[str, float]:
    """Kill a job's first process once, look, and run it again; what was seen."""
    job, folder, before = one.job, one.folder, shared_memory()
    process = start(job.words.split(), folder, environment(folder))
    time.sleep(one.delay)
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
        said = stream.read()
    what = f"{job.name}, {number.name} at {one.delay:.2f} s"
    assert "Traceback" not in said, f"{what}:\n{said}"
    if running:
        # A signal before Python has begun to handle it ends the process as the system does.
        expected = {0, -number} | ({143} if number == signal.SIGTERM else set())
        assert code in expected, f"{what}: exit code {code}\n{said}"
    left = leftovers(folder, set(members), before)
    assert not left, f"{what} left {left}"
    whole([*job.words.split(), *(job.again.split() if (folder / "out").exists() else [])], folder)
    assert (folder / job.result).is_file()
    locks = [path for path in folder.rglob("*") if path.name in {LOCK, HOLDER}]
    assert not locks, f"{what}, then run again, left {locks}"
    print(f"trial {one.number + 1}: {what}, all ended after {ended:.2f} s", file=sys.stderr)
    return {"killed": running, "others": max(0, len(members) - 1), "seconds": ended}


def campaign(
    count: int, seed: int, names: tuple[str, ...] = (), seconds: float = float("inf")
) -> dict[str, dict[str, float]]:
    """Run trials in turn over the jobs, for a time; what was seen, by job."""
    jobs = [job for job in JOBS if not names or job.name in names]
    counts: dict[str, Counter[str]] = {job.name: Counter() for job in jobs}
    slowest, failed = dict.fromkeys(counts, 0.0), list[str]()

    def undisturbed(job: Job, folder: Path) -> None:
        whole(job.words.split(), folder)
        assert not (left := leftovers(folder, set(), set())), f"{job.name} left {left}"

    for one in trials(jobs, count, seed, undisturbed, seconds=seconds):
        kind = (signal.SIGKILL, signal.SIGTERM)[one.number // len(jobs) % 2]
        name = one.job.name
        counts[name]["trials"] += 1
        try:
            seen = trial(one, kind)
        except AssertionError as error:
            failed.append(
                f"trial {one.number + 1}: {name}, {kind.name} at {one.delay:.2f} s: {error}"
            )
            print(failed[-1], file=sys.stderr)
            continue
        counts[name]["held"] += 1
        counts[name]["killed while running"] += int(seen["killed"])
        counts[name]["with others running"] += int(seen["others"] > 0)
        slowest[name] = max(slowest[name], seen["seconds"])
    assert not failed, "\n".join([f"{len(failed)} trials failed", *failed])
    return {
        name: {**counter, "seconds until all had ended, at most": round(slowest[name], 2)}
        for name, counter in counts.items()
    }


if __name__ == "__main__":
    main(__doc__, JOBS, campaign, 70)
