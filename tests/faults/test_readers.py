"""Bounded fuzzing of every reader: damaged files end in its own error, in one line, or are read."""

import hashlib
import io
import json
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controllers import Parameters, Problem
from controllers.errors import ParameterError
from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import PlantError, RecordingError, ScenarioError, TrajectoryError
from cosim.core.trajectory import read_csv
from cosim.plant.fmi import unpack
from cosim.recording import RerunRecorder, read_recording
from fmus import path as shipped
from learning import checkpoint
from learning.errors import CheckpointError
from learning.training import run_training
from tests.helpers.training import make_run

# A recording and an FMU cost much more to read than a page of text.
EXAMPLES = {"recording": 6, "fmu": 8}
LENIENT = {
    "deadline": None,
    "database": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}


@dataclass(frozen=True)
class Reader:
    """A reader of a file, its error, and what it made of a good one.

    `seal` is a fingerprint of what was read, of readers that vouch for the content by a checksum:
    they must refuse every file from which they would read something else.
    """

    file: str
    read: Callable[[Path], Any]
    error: type[Exception]
    seal: Callable[[Any], object] = lambda read: None

    def refuses(self, path):
        """Whether a file is refused with one line; any other exception goes through."""
        try:
            self.read(path)
        except self.error as error:
            assert str(error).strip()
            assert "Traceback" not in str(error)
            return True
        return False


def load(path):
    return checkpoint.load(path, make_run().identity())


def sealed(state):
    content = json.dumps(state, default=lambda array: array.tobytes().hex())
    return hashlib.sha256(content.encode()).hexdigest()


PAPER = Scenario.load("paper")
PROBLEM = Problem.from_scenario(PAPER)
READERS = {
    "scenario": Reader("scenario.toml", Scenario.load, ScenarioError),
    "theta": Reader(
        "theta.toml", lambda p: Parameters.load(p, PROBLEM), ParameterError, lambda t: t.hash
    ),
    "checkpoint": Reader("checkpoint.npz", load, CheckpointError, sealed),
    "trajectory": Reader("trajectory.csv", lambda p: read_csv(p, PAPER), TrajectoryError),
    "recording": Reader("run.rrd", read_recording, RecordingError),
    "fmu": Reader("plant.fmu", unpack, PlantError),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A folder with a good file for every reader."""
    folder = tmp_path_factory.mktemp("good")
    with FmuPlant(PAPER) as plant:
        recorder = RerunRecorder(folder / "run.rrd")
        run = simulate(plant, naive(PAPER), 20, 0, recorder=recorder)
    run.write_csv(folder / "trajectory.csv")
    run_training(make_run(), folder)
    (folder / "scenario.toml").write_text(PAPER.to_toml())
    (folder / "plant.fmu").write_bytes(shipped().read_bytes())
    Parameters.naive(PROBLEM).save(folder / "theta.toml")
    return folder


@st.composite
def damage(draw):
    """A function that damages bytes: overwrites, cuts, inserts, repeats, swaps a word."""
    kind = draw(st.sampled_from(["flip", "cut", "insert", "remove", "repeat", "word"]))
    where = draw(st.floats(0, 1, exclude_max=True))
    size = draw(st.integers(1, 64))
    junk = draw(st.binary(min_size=1, max_size=16))
    word = draw(st.sampled_from(WORDS))

    def apply(data: bytes) -> bytes:
        at = int(where * len(data))
        if kind == "flip":
            return data[:at] + bytes([data[at] ^ (1 << size % 8)]) + data[at + 1 :]
        if kind == "cut":
            return data[:at]
        if kind == "insert":
            return data[:at] + junk + data[at:]
        if kind == "remove":
            return data[:at] + data[at + size :]
        if kind == "repeat":
            return data[: at + size] + data[at:]
        start = data.find(b"=", at) + 1
        end = data.find(b"\n", start)
        return data[:start] + b" " + word + data[end:] if 0 < start < end else data[:at] + word

    return apply


WORDS = [b"nan", b"inf", b"-1", b"1e400", b"true", b"'x'", b"[]", b"{}", b"[[1.0]]", b"\xff", b""]


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_refused_or_read_as_it_was(good, tmp_path, name):
    reader = READERS[name]
    content, target = (good / reader.file).read_bytes(), tmp_path / reader.file
    expected = reader.seal(reader.read(good / reader.file))

    @settings(max_examples=EXAMPLES.get(name, 40), **LENIENT)
    @given(st.lists(damage(), min_size=1, max_size=3))
    def attack(damages):
        data = content
        for each in damages:
            data = each(data) or b"\n"
        target.write_bytes(data)
        assert reader.refuses(target) or reader.seal(reader.read(target)) == expected

    attack()


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ["missing", "folder"])
def test_what_is_no_file_is_refused(tmp_path, name, kind):
    target = tmp_path / READERS[name].file
    if kind == "folder":
        target.mkdir()
    assert READERS[name].refuses(target)


class Evil:
    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


def test_a_checkpoint_with_a_pickle_inside_is_refused_and_not_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.array([Evil()], dtype=object), allow_pickle=True)
    with zipfile.ZipFile("checkpoint.npz", "w") as archive:
        archive.writestr("run.npy", stream.getvalue())
    with pytest.raises(CheckpointError):
        load(Path("checkpoint.npz"))
    Path("plain.npz").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(CheckpointError):
        load(Path("plain.npz"))
    assert not Path("executed").exists()
