"""`python -m benchmarks.fixed_costs`: what a user waits for beside the samples.

Processor seconds, the least of some repetitions: a sample of `cosim.simulate`, a short training of
a study, a picture, and a long run as text and by columns.
"""

import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cosim
from benchmarks.measuring import clock
from cosim import FmuPlant, Scenario, build_controller, simulate

REPETITIONS = 3
SAMPLES = 50_000
LONG = 200_000
STUDY = """
schema = 1
name = "short"
scenarios = ["paper"]
training_seeds = {{ first = 0, count = {count} }}
evaluation = {{ first_seed = 100000, seeds = 1, steps = 20 }}
[[case]]
name = "q"
algorithm = "q-learning"
samples = 20
start = "naive"
"""
FEW, MANY = 2, 12


def least(call):
    """Least processor seconds of a call."""
    seconds = []
    for _ in range(REPETITIONS):
        begin = clock()
        call()
        seconds.append(clock() - begin)
    return min(seconds)


def measure_samples(folder):
    """Print a sample from Python, and what writing a long run adds to it."""
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        controller = build_controller("tuned", scenario)
        seconds = least(lambda: simulate(plant, controller, SAMPLES, 0))
        print(f"cosim.simulate, {SAMPLES} samples: {1e6 * seconds / SAMPLES:.1f} µs a sample")
        run = simulate(plant, controller, LONG, 0)
    as_text = least(lambda: run.write_csv(folder / "trajectory.csv"))
    by_columns = least(lambda: run.write_parquet(folder / "trajectory.parquet"))
    alone = seconds / SAMPLES * LONG
    for name, spent in {"CSV": as_text, "Parquet": by_columns}.items():
        print(f"{LONG} samples as {name}: {spent:.2f} s, {spent / alone:.2f} × their run")


def measure_study(folder):
    """Print what a short training of a study takes."""
    spent = {}
    for count in (FEW, FEW, MANY):
        file = folder / f"study{count}.toml"
        file.write_text(STUDY.format(count=count), "utf-8")
        begin = clock()
        # A folder of its own: what is done is not done again.
        with TemporaryDirectory() as out:
            cosim.study(file, out)
        spent[count] = clock() - begin
    print(f"a training of 20 samples in a study: {(spent[MANY] - spent[FEW]) / (MANY - FEW):.2f} s")


def measure_picture(folder):
    """Print what `cosim simulate` takes with a picture and without."""
    seconds = {}
    for words in ((), ("--plot",)):
        spent = []
        for _ in range(REPETITIONS):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-m", "cosim", "simulate", "--json", "-n", "999", *words]
            subprocess.run(
                [*command, "--out", "run", "--overwrite"],
                cwd=folder,
                stdout=subprocess.DEVNULL,
                check=True,
            )
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent.append(after.ru_utime - before.ru_utime)
        seconds[words] = min(spent)
    without, with_picture = seconds.values()
    print(f"cosim simulate -n 999: {without:.2f} s, with --plot {with_picture:.2f} s")


def main():
    """Measure all."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        measure_samples(folder)
        measure_study(folder)
        measure_picture(folder)


if __name__ == "__main__":
    main()
