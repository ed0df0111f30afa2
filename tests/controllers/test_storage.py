import os
import stat

import pytest

from controllers.storage import user_cache, write_atomically


def test_text_is_written_as_utf8_and_bytes_as_they_are(tmp_path):
    assert write_atomically(tmp_path / "text", "θ\n").read_bytes() == "θ\n".encode()
    assert write_atomically(tmp_path / "bytes", b"\x00\xff").read_bytes() == b"\x00\xff"


def test_what_stood_there_survives_a_failure(tmp_path, monkeypatch):
    path = write_atomically(tmp_path / "file", "old")
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_the_file_is_as_readable_as_any_other(tmp_path):
    (tmp_path / "plain").write_text("")
    path = write_atomically(tmp_path / "file", "")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_a_folder_that_is_not_there_raises_oserror(tmp_path):
    with pytest.raises(OSError, match="No such file"):
        write_atomically(tmp_path / "missing" / "file", "")


def test_the_cache_lies_where_the_environment_says_else_where_the_platform_does(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    assert user_cache("optima") == tmp_path / "optima"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COSIM_CACHE", "here")
    assert user_cache("fmus") == tmp_path / "here" / "fmus"
    monkeypatch.setenv("COSIM_CACHE", "")
    assert user_cache("fmus").parts[-2:] == ("rti-cosim", "fmus")
