import os
import stat

import pytest

from cosim import cache
from cosim.cache import (
    TAG,
    TAGGED,
    UNFINISHED_DAYS,
    UNUSED_DAYS,
    is_own_folder,
    own_folder,
    read_own,
    sweep,
    trusted_folder,
    user_cache,
)

pytestmark = pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_temporary", {})
    return tmp_path / "cache"


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


def test_the_folder_is_made_and_closed_to_others(own_cache):
    folder = trusted_folder("compiled")
    assert folder == own_cache / "compiled"
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(own_cache.stat().st_mode) == 0o700


@pytest.mark.parametrize("level", ["cache", "cache/compiled"])
@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_a_folder_that_others_can_write_is_not_used(tmp_path, level, mode):
    trusted_folder("compiled")
    (tmp_path / level).chmod(mode)
    folder = trusted_folder("compiled")
    assert tmp_path not in folder.parents
    assert is_own_folder(folder)
    assert trusted_folder("compiled") == folder


@pytest.mark.parametrize("level", ["cache", "cache/compiled"])
def test_a_link_in_place_of_the_folder_is_not_followed(tmp_path, level):
    trusted_folder("compiled")
    (tmp_path / level).rename(tmp_path / "elsewhere")
    (tmp_path / level).symlink_to(tmp_path / "elsewhere")
    assert tmp_path not in trusted_folder("compiled").parents


def test_another_users_folder_is_not_used(own_cache, monkeypatch):
    trusted_folder("compiled")
    owner = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    assert own_cache not in trusted_folder("compiled").parents


def test_a_cache_that_cannot_be_made_is_replaced_by_a_temporary_folder(own_cache):
    own_cache.write_text("a file")
    assert trusted_folder("compiled").is_dir()


def test_a_file_is_read_only_if_nobody_else_can_have_written_it(tmp_path):
    path = tmp_path / "library"
    path.write_bytes(b"code")
    path.chmod(0o600)
    assert read_own(path) == b"code"
    link = tmp_path / "link"
    link.symlink_to(path)
    with pytest.raises(OSError, match="symbolic link"):
        read_own(link)
    path.chmod(0o620)
    with pytest.raises(PermissionError, match="this user alone"):
        read_own(path)
    path.chmod(0o600)
    (tmp_path / "second name").hardlink_to(path)
    with pytest.raises(PermissionError, match="this user alone"):
        read_own(path)


def test_a_fifo_in_place_of_a_file_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(OSError, match="this user alone"):
        read_own(tmp_path / "fifo")


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o757])
def test_a_cache_that_others_can_replace_is_not_used(tmp_path, monkeypatch, mode):
    above = tmp_path / "above"
    above.mkdir()
    monkeypatch.setenv("COSIM_CACHE", str(above / "cache"))
    assert trusted_folder("compiled") == above / "cache" / "compiled"
    above.chmod(mode)
    assert above not in trusted_folder("compiled").parents
    with pytest.raises(PermissionError, match="other users can replace it"):
        own_folder("compiled")


def test_a_folder_for_temporary_files_of_all_is_none_that_others_can_replace(tmp_path, monkeypatch):
    (tmp_path / "above").mkdir()
    (tmp_path / "above").chmod(0o1777)
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "above" / "cache"))
    assert own_folder("compiled").parent.parent == tmp_path / "above"


def aged(path, days):
    then = path.lstat().st_mtime - days * 86400
    os.utime(path, (then, then), follow_symlinks=False)


HASH = "0123456789abcdef" * 4
OWN = [HASH, HASH[:16] + ".npz", HASH[:32] + "." + HASH, HASH[:32] + ".lock"]
WORDS = ["plant.fmu", "results", ".git", "thesis.tex"]
FOREIGN = [*WORDS, "0123", HASH + "0", HASH.upper(), "zz" * 32]


@pytest.mark.parametrize("name", OWN)
def test_what_was_not_used_for_long_is_swept(name):
    folder = own_folder("fmus")
    for kind in ("old", "new"):
        (folder / name.replace("0", {"old": "0", "new": "1"}[kind], 1)).mkdir()
    aged(folder / name, UNUSED_DAYS + 1)
    aged(folder / name.replace("0", "1", 1), UNUSED_DAYS - 1)
    sweep(folder)
    assert {path.name for path in folder.iterdir()} == {TAG, name.replace("0", "1", 1)}


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_what_is_not_ours_is_never_swept(tmp_path, name, kind):
    folder = own_folder("fmus")
    path = folder / name
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "kept").touch()
    if kind == "link":
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.touch() if kind == "file" else path.mkdir()
    aged(path, 10 * UNUSED_DAYS)
    sweep(folder)
    assert path.is_symlink() or path.exists()
    assert (tmp_path / "elsewhere" / "kept").exists()


def test_a_link_of_our_name_is_swept_and_not_followed(tmp_path):
    folder = own_folder("fmus")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "kept").touch()
    (folder / HASH).symlink_to(tmp_path / "elsewhere")
    aged(folder / HASH, UNUSED_DAYS + 1)
    sweep(folder)
    assert not (folder / HASH).is_symlink()
    assert (tmp_path / "elsewhere" / "kept").exists()


@pytest.mark.parametrize("mark", ["none", "another", "a link"])
def test_a_folder_without_our_mark_is_never_swept(own_cache, tmp_path, mark):
    (own_cache / "fmus").mkdir(parents=True)
    old = own_cache / "fmus" / HASH
    old.mkdir()
    aged(old, 10 * UNUSED_DAYS)
    folder = own_folder("fmus")
    if mark == "another":
        (folder / TAG).write_text("another")
    elif mark == "a link":
        (tmp_path / "tag").write_text(TAGGED)
        (folder / TAG).symlink_to(tmp_path / "tag")
    sweep(folder)
    assert old.exists()


def test_what_a_killed_process_left_unfinished_is_swept_sooner():
    folder = own_folder("fmus")
    for name, days in ((".partial-old", UNFINISHED_DAYS + 1), (".partial-new", 0)):
        (folder / name).mkdir()
        aged(folder / name, days)
    sweep(folder)
    assert {path.name for path in folder.iterdir()} == {TAG, ".partial-new"}
