"""Commands of this version beside the same commands of another version, in turns.

Each command runs as a process of its own with the Python of the tree's `.venv`, so that both
versions are measured as their users have them. Times are processor time of the process and of all
that it starts.
"""

import resource
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measuring import figure

REPETITIONS = 5
SHORT_SEEDS, LONG_SEEDS = 4, 44
"""Seeds of the two evaluations whose difference gives the time of a sample alone."""
TRAINING_SAMPLES = 10_000


def measure(scenario, steps, against):
    """Time `evaluate`, `train` and `export` in this folder and in the folder `against`.

    Args:
        scenario: Scenario of all commands; a preset of both versions.
        steps: Samples of an evaluation for each seed.
        against: Root of the other version's sources, with its `.venv`.

    Returns:
        Rows: a sample of `evaluate` of one controller, a sample of `train`, one `export`. A ratio
        is the other version's time over this one's.
    """
    here, there = Path.cwd(), Path(against).resolve()
    evaluate = ["evaluate", "-c", "tuned", "--steps", str(steps), "--seeds"]
    train = ["train", "-a", "q-learning", "--samples", str(TRAINING_SAMPLES)]
    commands = {
        "short": [*evaluate, str(SHORT_SEEDS), "-s", scenario.name],
        "long": [*evaluate, str(LONG_SEEDS), "-s", scenario.name],
        "train": [*train, "--start", "tuned", "-s", scenario.name],
        "export": ["export", "tuned", "--local", "-s", scenario.name],
    }
    spent = {tree: {name: [] for name in commands} for tree in (here, there)}
    for turn in range(REPETITIONS + 1):
        for name, command in commands.items():
            for tree in (here, there):
                seconds = processor_time(tree, command)
                if turn:  # the first one fills the caches
                    spent[tree][name].append(seconds)
    samples = steps * (LONG_SEEDS - SHORT_SEEDS)
    own, other = (of_a_sample(spent[tree], samples) for tree in (here, there))
    return [
        figure("sample of evaluate, one controller", own, there.name, other, at_least=1 / 0.55),
        row("train, 10 000 samples of Q-learning", "train", spent, here, there),
        row("export of an FMU", "export", spent, here, there),
    ]


def of_a_sample(seconds, samples):
    """Seconds of one sample of `evaluate`, from a long and a short command."""
    pairs = zip(seconds["long"], seconds["short"], strict=True)
    return [(long - short) / samples for long, short in pairs]


def row(title, name, spent, here, there):
    """Row of the table for one whole command."""
    return figure(title, spent[here][name], there.name, spent[there][name], at_least=1 / 1.1)


def processor_time(tree, command):
    """Processor time in s of one command with the Python of `tree`."""
    suffix = ".fmu" if command[0] == "export" else ""
    with TemporaryDirectory() as folder:
        out = ["--out", str(Path(folder, f"out{suffix}"))]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [tree / ".venv/bin/cosim", *command, *out],
            cwd=tree,
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
