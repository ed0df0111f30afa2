"""Presses Ctrl-C once, at random early moments, and reads what the command says.

    python -m tests.faults.ctrl_c --trials 50

Every trial: start a command that would run for hours in a process group of its own, as a terminal
does, wait until its folder is there, and interrupt all of the group after a random part of the
seconds in which workers start and modules are imported. One line must come of it, and exit code
130. Prints the trials and what held as JSON; ends in an AssertionError where one did not.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.helpers.command import LONG_STUDY, start_cosim
from tests.helpers.processes import eventually

EARLY = 2.5
"""Seconds within which the key is pressed."""
COMMANDS = (
    "evaluate --seeds 9999 -n 1000 --jobs 2",
    "study run study.toml --jobs 2",
    "evaluate --seeds 9999 -n 1000 --jobs 1",
    "simulate -n 5000000",
    "train -a batch-q-learning -n 9999999",
)


def trial(command: str, delay: float) -> None:
    """Interrupt a command `delay` seconds after its folder was made; raises AssertionError."""
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top)
        (folder / "study.toml").write_text(LONG_STUDY)
        words = [*command.split(), "--out", "out"]
        # A compiler would make the moments of the imports other ones.
        environment = {"COSIM_COMPILE": "never"}
        with start_cosim(*words, folder=folder, env=environment, start_new_session=True) as process:
            try:
                assert eventually((folder / "out").is_dir, 120)
                time.sleep(delay)
                os.killpg(process.pid, signal.SIGINT)
                _, said = process.communicate(timeout=60)
            finally:
                process.kill()
        assert process.returncode == 130, f"exit code {process.returncode}: {said}"
        assert said.startswith("interrupted") and said.count("\n") == 1, said


def campaign(count: int, seed: int) -> dict[str, dict[str, int]]:
    """Trials over the commands in turn; how many there were and how many held, by command."""
    draw = random.Random(seed)
    seen: dict[str, Counter[str]] = {command: Counter(trials=0, held=0) for command in COMMANDS}
    failed = list[str]()
    for number in range(count):
        command, delay = COMMANDS[number % len(COMMANDS)], draw.uniform(0.0, EARLY)
        seen[command]["trials"] += 1
        try:
            trial(command, delay)
            seen[command]["held"] += 1
        except AssertionError as error:
            failed.append(f"{command}, after {delay:.2f} s: {error}")
            print(failed[-1], file=sys.stderr)
    assert not failed, f"{len(failed)} of {count} trials:\n" + "\n".join(failed)
    return {command: dict(counts) for command, counts in seen.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(json.dumps(campaign(options.trials, options.seed), indent=1))
