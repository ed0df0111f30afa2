"""Files are whole or not there, folders have one writer; caches are the user's alone."""

import errno
import os
import re
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.core import files
from cosim.core.errors import CosimError
from cosim.core.files import (
    cache_folder,
    lock,
    read_json,
    read_toml,
    replacing,
    staged,
    temporary_folder,
    write_atomically,
)
from tests.helpers.command import run_cosim

SLOW = pytest.mark.slow
posix = pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")


def test_a_lock_is_given_back_at_its_end(tmp_path):
    for _ in range(2):
        with lock(tmp_path / "lock", 0), pytest.raises(TimeoutError):
            lock(tmp_path / "lock", 0)


@posix
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch, number):
    import fcntl

    def flock(descriptor, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(OSError, match="locks") as caught:
        lock(tmp_path / "lock", 0)
    assert (caught.value.errno, caught.value.filename) == (number, str(tmp_path / "lock"))


def test_what_stood_there_survives_a_failure(tmp_path, monkeypatch):
    path = write_atomically(tmp_path / "file", "old")

    with pytest.raises(RuntimeError), replacing(path) as half:
        half.write_text("half")
        raise RuntimeError
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(5, "disk full")))
    with pytest.raises(OSError, match="disk full") as caught:
        write_atomically(path, "new")
    assert caught.value.filename == str(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@posix
@pytest.mark.parametrize("kind", ["folder", "fifo", "device", "link to a device"])
def test_what_is_not_a_file_is_never_replaced(tmp_path, kind):
    path = tmp_path / "target"
    if kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/null")
    before = path.lstat()
    with pytest.raises(FileExistsError):
        write_atomically(path, "new")
    assert (path.lstat().st_ino, path.lstat().st_mode) == (before.st_ino, before.st_mode)


@pytest.mark.parametrize("read", [read_toml, read_json])
@pytest.mark.parametrize(
    "content",
    [None, b"\xff", b"{ [ no", b"1", b"[" * 10**5, b"a = " + b"9" * 10**5],
    ids=["missing", "not UTF-8", "no document", "a number", "endless", "long number"],
)
def test_a_document_that_is_none_is_one_line_that_names_it(tmp_path, read, content):
    path = tmp_path / "document"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LookupError) as caught:
        read(path, "the document", LookupError)
    assert str(caught.value).startswith("the document ")


@pytest.fixture
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(files, "_temporary", {})
    return tmp_path / "cache"


@posix
@pytest.mark.parametrize("level", ["cache", "cache/compiled"])
@pytest.mark.parametrize("fault", [0o770, 0o707, "link", "owner", "file"])
def test_a_cache_that_others_can_write_is_not_used(own_cache, tmp_path, monkeypatch, level, fault):
    place = tmp_path / level
    (own_cache / "compiled").mkdir(parents=True, mode=0o700)
    own_cache.chmod(0o700)
    if fault == "link":
        place.rename(tmp_path / "elsewhere")
        place.symlink_to(tmp_path / "elsewhere")
    elif fault == "file":
        place.rename(tmp_path / "elsewhere")
        place.write_text("")
    elif fault == "owner":
        owner = os.geteuid()
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    else:
        place.chmod(fault)
    folder = cache_folder("compiled")
    assert tmp_path not in folder.parents
    assert cache_folder("compiled") == folder


def test_a_temporary_folder_is_deleted_with_what_is_in_it_whatever_is_raised(tmp_path):
    with pytest.raises(ZeroDivisionError), temporary_folder("mine-", tmp_path) as folder:
        assert folder.parent == tmp_path
        (folder / "deep" / "deeper").mkdir(parents=True)
        if os.name != "nt":
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


# The files of a run ----------------------------------------------------------------------------

OWNED = ("table.csv", "picture.png", "part-*.csv")


def _write(folder, names, text):
    for name in names:
        (folder / name).write_text(text)


def _texts(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_the_files_of_a_run_appear_together_and_none_of_another_stays(tmp_path):
    _write(tmp_path, ("table.csv", "picture.png", "part-1.csv", "mine.txt"), "old")
    with staged(tmp_path, OWNED) as stage:
        _write(stage, ("table.csv", "part-2.csv"), "new")
        assert (tmp_path / "table.csv").read_text() == "old"
    assert _texts(tmp_path) == {"table.csv": "new", "part-2.csv": "new", "mine.txt": "old"}


@pytest.mark.parametrize("when", ["while writing", "at the second move"])
@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_run_that_fails_leaves_the_files_of_the_one_before(tmp_path, monkeypatch, when, error):
    _write(tmp_path, ("table.csv", "picture.png"), "old")
    before, replace, moves = _texts(tmp_path), Path.replace, []

    def failing(self, target):
        moves.append(target)
        if len(moves) == 2:
            raise OSError("no")
        return replace(self, target)

    def run():
        with staged(tmp_path, OWNED) as stage:
            _write(stage, ("table.csv", "part-2.csv"), "new")
            if when == "while writing":
                raise error
            monkeypatch.setattr(Path, "replace", failing)

    with pytest.raises((OSError, KeyboardInterrupt)):
        run()
    assert _texts(tmp_path) == before


@pytest.mark.skipif(not hasattr(os, "kill") or os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_while_files_are_moved_waits_until_all_are(tmp_path, monkeypatch):
    replace = Path.replace

    def interrupted(self, target):
        os.kill(os.getpid(), signal.SIGINT)
        return replace(self, target)

    def run():
        with staged(tmp_path) as stage:
            _write(stage, ("a.csv", "b.csv"), "new")
            monkeypatch.setattr(Path, "replace", interrupted)

    with pytest.raises(KeyboardInterrupt):
        run()
    assert _texts(tmp_path) == {"a.csv": "new", "b.csv": "new"}


HOLD = (
    "import sys, time\n"
    "from pathlib import Path\n"
    "from cosim.core.files import hold\n"
    "hold(Path(sys.argv[1])); print('held', flush=True); time.sleep(600)\n"
)


@pytest.fixture
def holder(tmp_path):
    """A process that holds the folder `out`."""
    folder = tmp_path / "out"
    folder.mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, folder], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "-n", "10"],
        pytest.param(
            ["evaluate", "--controllers", "naive", "--seeds", "1"], marks=pytest.mark.slow
        ),
        pytest.param(["train", "-a", "q-learning", "-n", "10"], marks=SLOW),
    ],
)
def test_a_folder_that_is_being_written_is_refused(holder, tmp_path, command):
    done = run_cosim(*command, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert re.search(rf"written by process {holder.pid} on \S+ \(.*\) since \S+; ", done.stderr)
    (tmp_path / "out" / files.HOLDER).unlink()
    with pytest.raises(CosimError, match="another process"):
        files.hold(tmp_path / "out")


@SLOW
def test_the_lock_of_a_killed_process_is_given_back(holder, tmp_path):
    holder.kill()
    holder.wait()
    assert run_cosim("simulate", "-n", "10", "--out", tmp_path / "out").returncode == 0
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert not left & {files.LOCK, files.HOLDER}
