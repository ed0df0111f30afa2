import os
import stat

import pytest

from rti_storage import cache
from rti_storage.cache import is_own_folder, read_own, sweep, trusted_folder, user_cache

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


def test_what_was_not_used_for_long_is_swept(tmp_path):
    for name in ("old", "new"):
        (tmp_path / name).write_text(name)
        (tmp_path / f"{name} folder").mkdir()
    for name in ("old", "old folder"):
        os.utime(tmp_path / name, (0, 0))
    sweep(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"new", "new folder"}
