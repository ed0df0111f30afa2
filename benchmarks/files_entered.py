"""`python -m benchmarks.files_entered`: the files to open for a step, for `evaluate`, for export.

A file counts where one of its functions is called, anywhere down the chain of calls; what runs
while a module is imported does not count.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

import cosim
from cosim.core.modules import OURS, ROOT


class Entered:
    """Collects the package's own files whose functions are called in its context."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self._seen: set[object] = set()

    def __enter__(self) -> Entered:
        threading.setprofile(self._see)
        sys.setprofile(self._see)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)

    def _see(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or code in self._seen:
            return
        path = Path(code.co_filename)
        inside = path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in OURS
        above: FrameType | None = frame
        while inside and above is not None:
            name = above.f_globals.get("__name__", "")
            if above.f_code.co_name == "<module>" and name.partition(".")[0] in OURS:
                return
            above = above.f_back
        self._seen.add(code)
        if inside:
            self.files.add(path.relative_to(ROOT).as_posix())


def step() -> Entered:
    """2400 samples of Q-learning on a plant in operation, its steps of θ included."""
    from controllers import compile_functions
    from learning.algorithm import load_algorithm
    from learning.training_run import begin_training, make_run

    run = make_run("q-learning", cosim.Scenario.load("fouled"), 2400)
    with cosim.FmuPlant(run.scenario) as plant:
        loop = begin_training(run, load_algorithm(run.algorithm), plant)
        compile_functions(loop.controller, run.samples)
        with Entered() as found:
            for _ in range(run.samples):
                loop.advance()
    return found


def evaluate() -> Entered:
    """`cosim.evaluate` of one controller, long enough to be compiled."""
    with Entered() as found:
        cosim.evaluate("fouled", ["tuned"], 2, 2000)
    return found


def export() -> Entered:
    """`cosim export tuned`, for this machine alone."""
    from cosim.cli import app

    with TemporaryDirectory() as folder, Entered() as found:
        app(["export", "tuned", "--local", "--out", f"{folder}/tuned.fmu"], standalone_mode=False)
    return found


def main() -> None:
    """Print the number of files of each flow, and their names."""
    for flow in (step, evaluate, export):
        files = sorted(flow().files)
        print(f"{flow.__name__}: {len(files)}\n  " + "\n  ".join(files))


if __name__ == "__main__":
    main()
