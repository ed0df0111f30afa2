"""Temporary folders end with their process, whatever ends it, and nothing else does."""

import json
import os
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from cosim import caretaker
from cosim.temporary import new_temporary_folder, temporary_folder
from tests.helpers.processes import eventually

LINES = (
    "import os, sys, time\n"
    "from pathlib import Path\n"
    "from cosim.temporary import new_temporary_folder, temporary_folder\n"
)
HOLDER = LINES + (
    "import signal\n"
    "signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup ignores\n"
    "with temporary_folder('a-') as first, temporary_folder('b-', Path({parent!r})) as second:\n"
    "    for folder in (first, second, first / 'within'):\n"
    "        folder.mkdir(exist_ok=True)\n"
    "        (folder / 'file').write_text('x')\n"
    "    print('made', flush=True)\n"
    "    time.sleep(600)\n"
)
posix = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")


def run(program, folder, **options):
    folder.mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-c", program],
        env=os.environ | {"TMPDIR": str(folder), "TEMP": str(folder), "TMP": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


@posix
@pytest.mark.parametrize("group", [False, True])
@pytest.mark.parametrize("number", ["SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGSEGV"])
def test_a_process_that_is_ended_leaves_none(tmp_path, number, group):
    (tmp_path / "other").mkdir()
    program = HOLDER.format(parent=str(tmp_path / "other"))
    with run(program, tmp_path / "own", start_new_session=True) as process:
        assert process.stdout.readline() == "made\n"
        assert len(list(tmp_path.rglob("file"))) == 3
        (os.killpg if group else os.kill)(process.pid, getattr(signal, number))
    assert eventually(lambda: not list(tmp_path.glob("*/*")))


@pytest.mark.parametrize(
    ("end", "code"),
    [("pass", 0), ("sys.exit(3)", 3), ("raise ValueError", 1), ("os._exit(5)", 5)],
)
@pytest.mark.parametrize("closed", [False, True])
def test_a_process_that_ends_leaves_none(tmp_path, end, code, closed):
    within = "with temporary_folder('a-') as folder:\n    pass\n" if closed else ""
    program = f"{LINES}{within}folder = new_temporary_folder('b-')\n{end}\n"
    with run(program, tmp_path / "own") as process:
        process.communicate(timeout=60)
    assert process.returncode == code
    assert eventually(lambda: list((tmp_path / "own").iterdir()) == [])


def test_the_folder_is_deleted_at_the_end_of_the_block_with_what_is_in_it(tmp_path):
    with temporary_folder("mine-", tmp_path) as folder:
        assert folder.parent == tmp_path
        assert folder.name.startswith("mine-")
        (folder / "deep" / "deeper").mkdir(parents=True)
        (folder / "deep" / "file").touch()
    assert list(tmp_path.iterdir()) == []


@posix
def test_nobody_else_may_enter(tmp_path):
    before = os.umask(0)
    try:
        with temporary_folder("mine-", tmp_path) as folder:
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    finally:
        os.umask(before)


@pytest.mark.parametrize("name", ["a b", "θ\n", "quote\"'", "\udcff"])
def test_any_name_will_do(tmp_path, name):
    try:
        (tmp_path / name).mkdir()
    except (OSError, UnicodeError):
        pytest.skip("no such name on this system")
    program = LINES + f"new_temporary_folder('x-', Path({str(tmp_path / name)!r}))\nos._exit(0)\n"
    with run(program, tmp_path / "own") as process:
        process.communicate(timeout=60)
    assert eventually(lambda: not list((tmp_path / name).iterdir()))


def test_what_the_block_raises_goes_through(tmp_path):
    with pytest.raises(ZeroDivisionError), temporary_folder("mine-", tmp_path):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_an_os_error(tmp_path):
    with pytest.raises(OSError, match="missing"):
        new_temporary_folder("mine-", tmp_path / "missing")


def test_a_folder_that_is_gone_or_moved_is_no_matter(tmp_path):
    with temporary_folder("mine-", tmp_path) as folder:
        folder.rename(tmp_path / "kept")
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


def test_what_has_the_name_of_one_that_was_taken_back_stays(tmp_path):
    program = LINES + (
        f"with temporary_folder('x-', Path({str(tmp_path)!r})) as folder:\n    pass\n"
        "folder.mkdir()\nos._exit(0)\n"
    )
    with run(program, tmp_path / "own") as process:
        process.communicate(timeout=60)
    assert not eventually(lambda: not list(tmp_path.glob("x-*")), 1.0)


def test_threads_have_folders_of_their_own(tmp_path):
    found = []

    def work():
        with temporary_folder("mine-", tmp_path) as folder:
            found.append(folder)

    threads = [threading.Thread(target=work) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 20
    assert list(tmp_path.iterdir()) == []


def line(sign, path):
    return json.dumps([sign, path]).encode() + b"\n"


@pytest.mark.parametrize(
    ("lines", "left"),
    [
        ([], set()),
        ([line("+", "a")], {"a"}),
        ([line("+", "a"), line("-", "a")], set()),
        ([line("+", "a"), line("-", "a"), line("+", "a")], {"a"}),
        ([line("-", "a"), line("+", "b")], {"b"}),
        ([line("+", "a"), line("+", "b")[:-1]], {"a"}),
        ([line("+", "a"), b'["+"'], {"a"}),
    ],
)
def test_what_is_announced_and_not_taken_back_is_deleted(lines, left):
    assert caretaker.announced(lines) == left


def test_a_folder_in_which_somebody_still_writes_is_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(caretaker, "PAUSE", 0.0)
    calls = []

    def stubborn(folder, ignore_errors):
        calls.append(folder)
        if len(calls) == 3:
            Path(folder).rmdir()

    monkeypatch.setattr(caretaker.shutil, "rmtree", stubborn)
    (tmp_path / "own").mkdir()
    caretaker.delete({str(tmp_path / "own")})
    assert len(calls) == 3
