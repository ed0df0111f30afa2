"""The readers of files, each with a good file, and what it may do with a bad one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from controllers import Parameters, Problem
from controllers.errors import ParameterError
from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from cosim.errors import PlantError, RecordingError, ScenarioError, TrajectoryError
from cosim.plant.archive import unpack
from cosim.recording import RerunRecorder, read_recording
from cosim.trajectory import read_csv
from fmus import path as shipped
from learning.checkpoint import Checkpoint
from learning.checkpoint import load as load_checkpoint
from learning.errors import CheckpointError
from tests.helpers.training import make_run, train


@dataclass(frozen=True)
class Reader:
    """A reader, its error, the name and bytes of a good file, and how what was read compares.

    `seal` is a fingerprint of what was read, for readers that vouch for the content by a checksum:
    they must refuse every file from which they would read something else.
    """

    name: str
    file: str
    good: bytes
    original: Any
    read: Callable[[Path], Any]
    error: type[Exception]
    seal: Callable[[Any], str] | None = None

    def accepts_only_the_same(self, path: Path) -> None:
        """Refuse the file in one line, or read the very content of the good one."""
        if not self.refuses(path) and self.seal is not None:
            assert self.seal(self.read(path)) == self.seal(self.original)

    def refuses(self, path: Path) -> bool:
        """Read a file; whether it was refused with one line that is not empty.

        Any other exception goes through.
        """
        try:
            self.read(path)
        except self.error as error:
            message = str(error)
            assert message.strip()
            assert "Traceback" not in message
            return True
        return False


def _run(folder: Path) -> None:
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        recorder = RerunRecorder(folder / "run.rrd")
        run = simulate(plant, naive(scenario), 20, 0, recorder=recorder)
    run.write_csv(folder / "trajectory.csv")


def _seal(checkpoint: Checkpoint) -> str:
    digest = hashlib.sha256(repr((checkpoint.run, checkpoint.state)).encode())
    for name in sorted(checkpoint.arrays):
        digest.update(name.encode() + checkpoint.arrays[name].tobytes())
    return digest.hexdigest()


def readers(folder: Path) -> dict[str, Reader]:
    """Every reader with a good file of its own, made in `folder`."""
    scenario = Scenario.load("paper")
    problem = Problem.from_scenario(scenario)
    _run(folder)
    train(make_run(), folder)
    (folder / "scenario.toml").write_text(scenario.to_toml())
    (folder / "plant.fmu").write_bytes(shipped().read_bytes())
    Parameters.naive(problem).save(folder / "theta.toml")
    kinds: list[tuple[str, str, Any, type[Exception], Any]] = [
        ("scenario", "scenario.toml", Scenario.load, ScenarioError, None),
        ("theta", "theta.toml", lambda p: Parameters.load(p, problem), ParameterError,
         lambda theta: theta.hash),
        ("checkpoint", "checkpoint.npz", load_checkpoint, CheckpointError, _seal),
        ("trajectory", "trajectory.csv", lambda p: read_csv(p, scenario), TrajectoryError, None),
        ("recording", "run.rrd", read_recording, RecordingError, None),
        ("fmu", "plant.fmu", unpack, PlantError, None),
    ]  # fmt: skip
    return {
        name: Reader(name, file, (folder / file).read_bytes(), read(folder / file), read, *rest)
        for name, file, read, *rest in kinds
    }
