"""`python -m benchmarks.slow_plant`: what commands ask of an FMU whose step takes 20 ms.

The skeleton's plant, whose `fmi2DoStep` sleeps and adds a byte to a file, so that its steps are
counted in whichever process they are. Since it sleeps, two of them are as fast as one on any
machine, and what a command takes beside them is small.
"""

import json
import os
import runpy
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from unittest import mock

from fmus import build as fmu_build

NAME = "slow"
SECONDS = 0.02
COUNTED = "SLOW_PLANT_STEPS"
"""The variable of the environment that names the file with a byte for each step."""
PAUSE = """
#define _POSIX_C_SOURCE 200809L
#include <fcntl.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

static void take_time(void) {
    const struct timespec pause = {0, NANOSECONDS};
    const char *const file = getenv("COUNTED");
    const int log = file ? open(file, O_WRONLY | O_CREAT | O_APPEND, 0644) : -1;
    if (log >= 0 && write(log, ".", 1) == 1) close(log);
    nanosleep(&pause, 0);
}
"""
STEP = "    return (fmi2Status)do_step(instance, __func__, currentCommunicationPoint,"


def build(folder, seconds=SECONDS):
    """Make the skeleton's plant in a folder, slow; return the path of its scenario."""
    command("new", "plant", NAME, folder=folder)
    sources = folder / "sources"
    shutil.copytree(fmu_build.SOURCES, sources)
    face = sources / "fmi2.c"
    text = face.read_text("utf-8")
    assert text.count(STEP) == 1
    pause = PAUSE.replace("NANOSECONDS", f"{1e9 * seconds:.0f}").replace("COUNTED", COUNTED)
    face.write_text(pause + text.replace(STEP, f"    take_time();\n{STEP}"), "utf-8")
    with in_folder(folder), mock.patch.object(fmu_build, "SOURCES", sources):
        runpy.run_path(f"{NAME}.py", run_name="__main__")
    scenario = ["--model", f"{NAME}:model", "--out", f"{NAME}.toml"]
    command("scenario", "init", f"{NAME}.fmu", *scenario, folder=folder)
    return folder / f"{NAME}.toml"


@contextmanager
def in_folder(folder):
    """The folder as working directory."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def command(*words, folder):
    """Run `cosim` in a folder; seconds, the plant's steps, and the JSON document that it prints."""
    counted = folder / "steps"
    counted.unlink(missing_ok=True)
    begin = perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "cosim", *words, "--json"],
        cwd=folder,
        env=os.environ | {COUNTED: str(counted)},
        stdout=subprocess.PIPE,
        check=False,
    )
    seconds = perf_counter() - begin
    # A training whose θ is worse than its start ends with 1.
    assert done.returncode in (0, 1), done.returncode
    steps = counted.stat().st_size if counted.is_file() else 0
    return seconds, steps, json.loads(done.stdout)


def measure_jobs(folder, steps):
    """Print what two processes gain in an evaluation of eight seeds.

    Starting them takes as long as the machine likes: by the steps alone is the difference from runs
    of one step.
    """
    spent = {}
    for jobs in ("1", "2"):
        for length in (1, steps):
            words = ["evaluate", "-s", f"{NAME}.toml", "-c", "naive", "--seeds", "8"]
            words += ["--steps", str(length), "--jobs", jobs]
            words += ["--out", "evaluated", "--overwrite"]
            seconds, counted, _ = command(*words, folder=folder)
            spent[jobs, length] = seconds
            print(f"evaluate, 8 seeds × {length}, {jobs} jobs: {seconds:.1f} s, {counted} steps")
    whole = spent["1", steps] / spent["2", steps]
    alone = (spent["1", steps] - spent["1", 1]) / (spent["2", steps] - spent["2", 1])
    print(f"two jobs are {whole:.2f} × as fast, by the steps alone {alone:.2f} ×", flush=True)


def measure_training(folder, samples, *more):
    """Print the plant's steps of a training."""
    words = ["train", "-a", "q-learning", "-s", f"{NAME}.toml", "-n", str(samples), *more]
    seconds, counted, summary = command(*words, "--overwrite", "--out", "trained", folder=folder)
    print(
        f"train, {' '.join(more)} {samples} samples: {seconds:.1f} s, {counted} steps, of which "
        f"{summary['plant_samples']} in training, {summary['held_out_samples']} held out",
        flush=True,
    )


def main():
    """Measure all."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        build(folder)
        measure_jobs(folder, 50)
        measure_jobs(folder, 200)
        measure_training(folder, 200)
        measure_training(folder, 1000)
        measure_training(folder, 200, "--evaluation-seeds", "0")


if __name__ == "__main__":
    main()
