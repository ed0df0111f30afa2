"""A guarded command ends with the process that started it, whatever ends that."""

import os
import signal
import subprocess
import sys
import tempfile
import time

import pytest

from cosim.guarded import end_guarded, exit_code, start_guarded
from tests.helpers.processes import eventually, running

SLEEPER = (
    "import subprocess, sys, time\n"
    "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600) # {mark}'])\n"
    "time.sleep(600)\n"
)
GUARDED = (
    "import sys, time\n"
    "from cosim.guarded import end_guarded, start_guarded\n"
    "process = start_guarded([sys.executable, '-c', {program!r}])\n"
    "print('started', flush=True)\n"
    "time.sleep(600)\n"
)
FOLDER = (
    "import subprocess, sys, time\n"
    "from pathlib import Path\n"
    "from cosim.guarded import start_guarded\n"
    "process = start_guarded([sys.executable, '-c', {program!r}], folder=Path({folder!r}))\n"
    "print('started', flush=True)\n"
    "time.sleep(600)\n"
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@pytest.fixture
def mark():
    return f"mark-{os.getpid()}-{time.monotonic_ns()}"


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_guarded_command_and_its_children_end_with_the_parent(mark, number):
    program = SLEEPER.format(mark=mark)
    with subprocess.Popen(
        [sys.executable, "-c", GUARDED.format(program=program)], stdout=subprocess.PIPE
    ) as parent:
        parent.stdout.readline()
        assert eventually(lambda: len(running(mark)) >= 3)  # the guard, the child, the grandchild
        parent.send_signal(number)
    assert eventually(lambda: not running(mark))


def test_a_guarded_command_leaves_no_temporary_folder(tmp_path):
    script = "import tempfile; print(tempfile.mkdtemp())"
    with tempfile.TemporaryFile() as log:
        environment = os.environ | {"TMPDIR": str(tmp_path)}
        guard = start_guarded([sys.executable, "-c", script], env=environment, log=log)
        assert guard.wait() == 0
        end_guarded(guard)
        log.seek(0)
        assert log.read().decode().startswith(str(tmp_path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("code", [0, 3])
def test_the_guard_passes_the_exit_code_on(code):
    guard = start_guarded([sys.executable, "-c", f"raise SystemExit({code})"])
    assert guard.wait() == code
    end_guarded(guard)


def test_the_folder_of_a_guarded_command_ends_with_the_parent(mark, tmp_path):
    own = tmp_path / "own"
    own.mkdir()
    script = FOLDER.format(program=SLEEPER.format(mark=mark), folder=str(own))
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as parent:
        parent.stdout.readline()
        assert eventually(lambda: len(running(mark)) >= 3)
        parent.kill()
    assert eventually(lambda: not running(mark) and not own.exists())


@pytest.mark.parametrize("code", [0, 3])
def test_a_guarded_command_in_a_folder_leaves_what_it_made_until_the_parent_lets_go(tmp_path, code):
    own = tmp_path / "own"
    own.mkdir()
    script = f"import pathlib; pathlib.Path('made').touch(); raise SystemExit({code})"
    guard = start_guarded([sys.executable, "-c", script], folder=own)
    assert eventually(lambda: exit_code(own) is not None)
    assert exit_code(own) == code
    assert (own / "made").exists()
    assert guard.poll() is None
    end_guarded(guard)
    assert not own.exists()


def test_what_was_made_and_not_taken_ends_with_the_parent(tmp_path):
    own = tmp_path / "own"
    own.mkdir()
    script = FOLDER.format(program="pass", folder=str(own))
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as parent:
        parent.stdout.readline()
        assert eventually(lambda: exit_code(own) == 0)
        parent.kill()
    assert eventually(lambda: not own.exists())
