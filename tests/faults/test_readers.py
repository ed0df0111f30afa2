"""Bounded fuzzing of every reader: damaged files end in its own error, in one line, or are read."""

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from learning import checkpoint
from learning.errors import CheckpointError

NAMES = ("scenario", "theta", "checkpoint", "trajectory", "recording", "fmu")
# A recording and an FMU cost much more to read than a page of text.
EXAMPLES = {"recording": 6, "fmu": 8}
LENIENT = {
    "deadline": None,
    "database": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}


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


def fuzz(reader, folder: Path, examples: int) -> None:
    target = folder / reader.file
    target.parent.mkdir(exist_ok=True, parents=True)

    @settings(max_examples=examples, **LENIENT)
    @given(st.lists(damage(), min_size=1, max_size=3))
    def attack(damages):
        data = reader.good
        for each in damages:
            data = each(data) or b"\n"
        target.write_bytes(data)
        reader.accepts_only_the_same(target)

    attack()


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_refused_or_read_as_it_was(files, tmp_path, name):
    fuzz(files[name], tmp_path, EXAMPLES.get(name, 40))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["missing", "folder"])
def test_what_is_no_file_is_refused(files, tmp_path, name, kind):
    target = tmp_path / files[name].file
    if kind == "folder":
        target.mkdir()
    assert files[name].refuses(target)


class Evil:
    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


def test_a_checkpoint_with_a_pickle_inside_is_refused_and_not_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.array([Evil()], dtype=object), allow_pickle=True)
    with zipfile.ZipFile("checkpoint.npz", "w") as archive:
        archive.writestr("about.npy", stream.getvalue())
    with pytest.raises(CheckpointError):
        checkpoint.load(Path("checkpoint.npz"))
    Path("plain.npz").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(CheckpointError):
        checkpoint.load(Path("plain.npz"))
    assert not Path("executed").exists()
