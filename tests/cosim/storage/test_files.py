import os
import stat

import numpy as np
import pytest

from cosim.files import read_arrays, write_atomically


def test_text_is_written_as_utf8_and_bytes_as_they_are(tmp_path):
    assert write_atomically(tmp_path / "text", "θ\n").read_bytes() == "θ\n".encode()
    assert write_atomically(tmp_path / "bytes", b"\x00\xff").read_bytes() == b"\x00\xff"


def test_what_stood_there_survives_a_failure(tmp_path, monkeypatch):
    path = write_atomically(tmp_path / "file", "old")
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(5, "disk full")))
    with pytest.raises(OSError, match="disk full") as caught:
        write_atomically(path, "new")
    assert caught.value.filename == str(path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_the_file_is_as_readable_as_any_other(tmp_path):
    (tmp_path / "plain").write_text("")
    path = write_atomically(tmp_path / "file", "")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_a_folder_that_is_not_there_raises_oserror(tmp_path):
    with pytest.raises(OSError, match="No such file"):
        write_atomically(tmp_path / "missing" / "file", "")


def test_pieces_are_written_as_they_come_and_a_failure_between_them_leaves_nothing(tmp_path):
    path = write_atomically(tmp_path / "file", (f"{i}\n" for i in range(3)))
    assert path.read_text() == "0\n1\n2\n"

    def broken():
        yield "half"
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        write_atomically(path, broken())
    assert path.read_text() == "0\n1\n2\n"
    assert list(tmp_path.iterdir()) == [path]


def test_arrays_with_any_byte_changed_are_read_as_they_were_or_refused(tmp_path):
    path, arrays = tmp_path / "arrays.npz", {"a": np.arange(3.0), "b": np.array("text")}
    np.savez_compressed(path, **arrays)
    whole = path.read_bytes()
    refused = 0
    for position in range(len(whole)):
        for change in (0x01, 0x40, 0xFF):
            damaged = bytearray(whole)
            damaged[position] ^= change
            path.write_bytes(damaged)
            try:
                found = read_arrays(path)
            except ValueError:
                refused += 1
            else:
                assert all(np.array_equal(found[name], arrays[name]) for name in found)
    assert refused > len(whole)


def test_python_objects_are_refused_not_executed(tmp_path):
    np.savez(tmp_path / "arrays.npz", a=np.array([print], dtype=object))
    with pytest.raises(ValueError, match="pickle"):
        read_arrays(tmp_path / "arrays.npz")


def test_a_missing_file_is_no_damage(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "missing.npz")


@pytest.mark.skipif(os.name == "nt", reason="kinds of files of POSIX")
@pytest.mark.parametrize("kind", ["folder", "fifo", "link to a folder", "device"])
def test_what_is_no_regular_file_is_never_replaced(tmp_path, kind):
    path = tmp_path / "there"
    if kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to(tmp_path if kind == "link to a folder" else os.devnull)
    before = path.lstat()
    with pytest.raises(OSError, match="not a regular file") as caught:
        write_atomically(path, "new")
    assert caught.value.filename == str(path)
    assert (path.lstat().st_mode, path.lstat().st_ino) == (before.st_mode, before.st_ino)
    assert [entry.name for entry in tmp_path.iterdir()] == ["there"]
