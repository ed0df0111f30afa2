"""kill -9 at random moments of training, evaluation, recording and results update.

    python -m tests.faults.kill --trials 60

Every trial: start the command, kill its whole process group after a random share of the time that
it takes, look at all files that are there (each must be absent, or whole and right), run it again
(training with --resume where there is a checkpoint), and compare every byte with the run that
nobody killed. Prints what happened as JSON; ends in an AssertionError if anything was lost or
differs.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controllers import Parameters, Problem
from cosim import Scenario
from cosim.errors import RecordingError
from cosim.evaluation.store import FILE
from cosim.recording import read_recording
from learning.checkpoint import load as load_checkpoint
from tests.helpers.campaigns import Trial, finish, main, start, trials

STUDY = """\
schema = 1
name = "runs"
scenarios = ["paper"]
training_seeds = { first = 0, count = 2 }
evaluation = { seeds = 4, steps = 500 }
curves = { points = 4, seeds = 2, steps = 100 }
logs = ["q"]
[[case]]
controller = "tuned"
[[case]]
name = "q"
algorithm = "q-learning"
samples = 3000
training = { checkpoint_every = 750 }
[[trajectory]]
name = "run"
steps = 100
figures = ["overlay"]
"""
# So long that a small part of each command's time is its start, before it writes anything.
TRAIN = "train --algorithm batch-q-learning --samples 6000 --log-every 100 --evaluate-every 1000"
EVALUATE = "evaluate --seeds 8 --steps 2000 --jobs 2"
RECORD = "simulate --steps 20000 --record"


@dataclass(frozen=True)
class Job:
    """A command in a folder, its result files, and what must hold of files after a kill."""

    name: str
    words: Callable[[Path], list[str]]
    results: tuple[str, ...]
    inspect: Callable[[Path, Path], Counter[str]]
    begin: Callable[[Path], None] = lambda folder: None


def _train(folder: Path) -> list[str]:
    words = [*TRAIN.split(), "--checkpoint-every", "100", "--out", "out"]
    return [*words, "--resume"] if (folder / "out" / "checkpoint.npz").exists() else words


def _inspect_training(folder: Path, _: Path) -> Counter[str]:
    out, seen = folder / "out", Counter[str]()
    if (out / "checkpoint.npz").exists():
        load_checkpoint(out / "checkpoint.npz")
        seen["checkpoints found"] += 1
    if (out / "parameters.toml").exists():
        Parameters.load(out / "parameters.toml", Problem.from_scenario(Scenario.load("paper")))
        seen["θ files found"] += 1
    if (out / "learning.csv").exists():
        with (out / "learning.csv").open(newline="") as stream:
            assert len({len(row) for row in csv.reader(stream)}) <= 1
    return seen


def _inspect_units(folder: Path, reference: Path) -> Counter[str]:
    found, there = (_units(place / "out" / FILE) for place in (folder, reference))
    assert found <= there
    return Counter({"finished units found": len(found)})


def _units(path: Path) -> set[str]:
    """Key, seeds and indicators of the finished units in a file, the torn one apart."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    whole = [json.loads(line) for line in lines if line.endswith("\n")]
    # As text: a settling time that does not exist is NaN.
    return {json.dumps([unit[name] for name in ("key", "seeds", "indicators")]) for unit in whole}


def _inspect_recording(folder: Path, reference: Path) -> Counter[str]:
    out = folder / "out"
    whole = read_recording(reference / "out" / "run.rrd")
    if (out / "run.rrd").exists():
        assert np.array_equal(read_recording(out / "run.rrd").samples, whole.samples)
        return Counter({"whole recordings found": 1})
    partial = next(out.glob(".run.*.partial.rrd"), None)
    if partial is None or partial.stat().st_size == 0:
        return Counter()
    repaired = folder / "repaired.rrd"
    rerun = str(Path(sys.executable).with_name("rerun"))
    command = [rerun, "rrd", "optimize", str(partial), "-o", str(repaired)]
    subprocess.run(command, capture_output=True, check=False)
    try:
        found = read_recording(repaired)
    except RecordingError:
        return Counter({"partial recordings without a block": 1})
    rows = len(found.samples)
    assert np.array_equal(found.samples, whole.samples[:rows])
    for name, values in found.signals.items():
        # The last block may have reached the disk for some signals only: the others have gaps.
        there = ~np.isnan(values) & (not name.endswith("_time"))
        assert np.array_equal(values[there], whole.signals[name][:rows][there]), name
    return Counter({"partial recordings repaired": 1, "samples repaired": rows})


def _stored(folder: Path) -> None:
    (folder / "results").mkdir(exist_ok=True)
    (folder / "results" / "runs.toml").write_text(STUDY)
    (folder / "results" / "tolerances.toml").write_text("[tolerance]\n")


def _inspect_results(folder: Path, reference: Path) -> Counter[str]:
    seen = Counter[str]()
    for path in (folder / "results").rglob("*"):
        name = path.relative_to(folder)
        if path.is_file() and ".work" not in name.parts and not path.name.startswith("."):
            assert path.read_bytes() == (reference / name).read_bytes(), name
            seen["result files found"] += 1
    return seen


JOBS = (
    Job("training", _train, ("out/learning.csv", "out/parameters.toml"), _inspect_training),
    Job(
        "evaluation",
        lambda _: [*EVALUATE.split(), "--out", "out"],
        ("out/evaluation.csv",),
        _inspect_units,
    ),
    Job(
        "recording",
        lambda _: [*RECORD.split(), "--out", "out"],
        ("out/trajectory.csv", "out/scenario.toml"),
        _inspect_recording,
    ),
    Job(
        "results update",
        lambda _: ["results", "update", "--results", "results"],
        ("results/README.md", "results/runs/summary.csv", "results/runs/evaluation.csv"),
        _inspect_results,
        _stored,
    ),
)


def trial(one: Trial[Job]) -> Counter[str]:
    """Kill a job once, look, finish it, compare; what was seen."""
    job, folder, what = one.job, one.folder, f"{one.job.name} after a kill at {one.delay:.2f} s"
    process = start(job.words(folder), folder, group=True)
    time.sleep(one.delay)
    running = process.poll() is None
    if running:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    seen = Counter({"trials": 1, "killed": int(running)}) + job.inspect(folder, one.reference)
    finish(start(job.words(folder), folder), what)
    for name in job.results:
        same = (folder / name).read_bytes() == (one.reference / name).read_bytes()
        assert same, f"{what}: {name} differs"
    seen["equal to the byte afterwards"] += 1
    return seen


def campaign(
    count: int, seed: int, names: tuple[str, ...] = (), seconds: float = float("inf")
) -> dict[str, dict[str, int]]:
    """Run trials in turn over the jobs, for a time; what was seen, by job."""
    jobs = [job for job in JOBS if not names or job.name in names]
    seen: dict[str, Counter[str]] = {job.name: Counter() for job in jobs}

    def whole(job: Job, folder: Path) -> None:
        finish(start(job.words(folder), folder), job.name)

    for one in trials(jobs, count, seed, whole, seconds=seconds):
        seen[one.job.name] += trial(one)
        print(f"trial {one.number + 1}: {one.job.name}, kill at {one.delay:.2f} s", file=sys.stderr)
    return {name: dict(counter) for name, counter in seen.items()}


if __name__ == "__main__":
    main(__doc__, JOBS, campaign, 60)
