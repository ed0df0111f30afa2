"""What a command starts ends with it, whatever ends the command itself."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from cosim.lifetime import end_guarded, start_guarded

SLEEPER = (
    "import subprocess, sys, time\n"
    "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600) # {mark}'])\n"
    "time.sleep(600)\n"
)
GUARDED = (
    "import sys, time\n"
    "from cosim.lifetime import end_guarded, start_guarded\n"
    "process = start_guarded([sys.executable, '-c', {program!r}])\n"
    "print('started', flush=True)\n"
    "time.sleep(600)\n"
)
WORKERS = (
    "import os, time\n"
    "from cosim.evaluation.parallel import run_all\n"
    "def work(path):\n"
    "    open(path + str(os.getpid()), 'w').close()\n"
    "    time.sleep(600)\n"
    "run_all(work, {{str(k): {folder!r} + '/' for k in range(4)}}.items(), print, jobs=2)\n"
)


def alive(number):
    """Whether a process runs; a dead one that nobody waits for counts as ended."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def running(mark):
    """Numbers of the processes whose command line has a mark."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "cmdline").read_bytes() and alive(folder.name):
                found.append(folder.name)
        except OSError:
            continue
    return found


def eventually(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.05)
    return False


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


def test_workers_end_with_the_parent(tmp_path):
    program = WORKERS.format(folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL) as parent:
        assert eventually(lambda: len(list(tmp_path.iterdir())) == 2)
        workers = [int(path.name) for path in tmp_path.iterdir()]
        parent.kill()
    assert eventually(lambda: not any(map(alive, workers)))


def test_sigterm_unwinds_the_command_and_says_so(tmp_path):
    command = [sys.executable, "-m", "cosim", "simulate", "--scenario", "paper"]
    options = ["--controller", "naive", "--steps", "2000000", "--out", str(tmp_path / "out")]
    with subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True) as process:
        assert eventually((tmp_path / "out").is_dir)
        time.sleep(1.0)  # into the run
        process.terminate()
        _, words = process.communicate(timeout=60)
    assert process.returncode == 143
    assert words == "terminated\n"
    assert list((tmp_path / "out").iterdir()) == []
