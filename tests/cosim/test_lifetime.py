"""What a command starts ends with it, whatever ends the command itself."""

import subprocess
import sys
import time

import pytest

from tests.helpers.command import start_cosim
from tests.helpers.processes import alive, eventually

WORKERS = (
    "import os, time\n"
    "from cosim.evaluation.parallel import run_all\n"
    "def work(path):\n"
    "    open(path + str(os.getpid()), 'w').close()\n"
    "    time.sleep(600)\n"
    "run_all(work, {{str(k): {folder!r} + '/' for k in range(4)}}.items(), print, jobs=2)\n"
)


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def test_workers_end_with_the_parent(tmp_path):
    program = WORKERS.format(folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL) as parent:
        assert eventually(lambda: len(list(tmp_path.iterdir())) == 2)
        workers = [int(path.name) for path in tmp_path.iterdir()]
        parent.kill()
    assert eventually(lambda: not any(map(alive, workers)))


def test_a_worker_whose_parent_ended_before_it_asked_ends(tmp_path):
    program = "import time; from cosim.lifetime import follow_parent; follow_parent(1 << 30); "
    with subprocess.Popen([sys.executable, "-c", f"{program}time.sleep(600)"]) as worker:
        assert worker.wait(60) == 1


def test_sigterm_unwinds_the_command_and_says_so(tmp_path):
    options = ["--controller", "naive", "--steps", "2000000", "--out", str(tmp_path / "out")]
    with start_cosim("simulate", "--scenario", "paper", *options) as process:
        assert eventually((tmp_path / "out").is_dir)
        time.sleep(1.0)  # into the run
        process.terminate()
        _, words = process.communicate(timeout=60)
    assert process.returncode == 143
    assert words == "terminated\n"
    assert list((tmp_path / "out").iterdir()) == []
