"""Whatever ends a command ends what it started."""

import os
import signal
import subprocess
import sys

import pytest

from cosim.core.processes import child_process
from tests.helpers.command import alive, eventually, run_cosim

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
SLOW = pytest.mark.slow

WORKERS = (
    "import os, time\n"
    "from cosim import evaluate\n"
    "class Sleeping:\n"
    "    def __init__(self, scenario): pass\n"
    "    def reset(self):\n"
    "        open({folder!r} + '/' + str(os.getpid()), 'w').close()\n"
    "        time.sleep(600)\n"
    "    def prepare(self): pass\n"
    "    def feedback(self, s, a=None): pass\n"
    "evaluate('paper', {{str(k): Sleeping for k in range(4)}}, 1, 5, jobs=2)\n"
)


@linux
@SLOW
def test_workers_end_with_the_parent(tmp_path):
    program = WORKERS.format(folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL) as parent:
        assert eventually(lambda: len(list(tmp_path.iterdir())) == 2)
        workers = [int(path.name) for path in tmp_path.iterdir()]
        parent.kill()
    assert eventually(lambda: not any(map(alive, workers)))


CHILD = (
    "import subprocess, sys\n"
    "from cosim.core.processes import command_process, child_process\n"
    "words = [sys.executable, '-c', 'import os, time; print(os.getpid(), flush=True);'\n"
    "         'time.sleep(600)']\n"
    "with command_process(), child_process(words) as child:\n    child.wait(600.0)\n"
)


@linux
@pytest.mark.parametrize("group", [False, True])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_child_ends_with_its_parent(number, group):
    with subprocess.Popen(
        [sys.executable, "-c", CHILD],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        # nohup ignores SIGHUP
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # noqa: PLW1509
    ) as process:
        child = int(process.stdout.readline())
        (os.killpg if group else os.kill)(process.pid, number)
        assert eventually(lambda: not alive(child))


@pytest.mark.slow
def test_a_child_that_takes_too_long_is_ended_with_its_children(tmp_path):
    program = (
        "import subprocess, sys, signal, time, pathlib\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "pathlib.Path('number').write_text(str(child.pid))\n"
        "time.sleep(600)\n"
    )
    command, late = [sys.executable, "-c", program], subprocess.TimeoutExpired
    with pytest.raises(late), child_process(command, folder=tmp_path) as child:
        child.wait(2.0)
    number = int((tmp_path / "number").read_text())
    assert eventually(lambda: not alive(number))


def test_a_child_has_its_exit_code_and_its_temporary_files_in_its_folder(tmp_path):
    program = "import sys, tempfile; open('here', 'w').write(tempfile.gettempdir()); sys.exit(3)"
    with child_process([sys.executable, "-c", program], folder=tmp_path) as child:
        assert child.wait(60.0) == 3
    assert (tmp_path / "here").read_text() == str(tmp_path)


@SLOW
def test_a_recording_of_another_run_does_not_stand_beside_the_signals(tmp_path):
    assert run_cosim("simulate", "-n", "20", "--record", "--out", tmp_path).returncode == 0
    assert (tmp_path / "run.rrd").exists()
    again = ["simulate", "-n", "20", "--seed", "1", "--out", tmp_path]
    assert run_cosim(*again).returncode == 2
    assert run_cosim(*again, "--overwrite").returncode == 0
    assert not (tmp_path / "run.rrd").exists()


@SLOW
def test_a_training_is_neither_overwritten_nor_mixed_unless_asked(tmp_path):
    words = ["train", "-a", "q-learning", "--scenario", "paper", "--json", "-n", "300"]
    words += ["--log-every", "100", "--checkpoint-every", "300", "--out", str(tmp_path)]
    assert run_cosim(*words).returncode == 0
    kept = (tmp_path / "learning.csv").read_bytes()
    assert run_cosim(*words, "--seed", "1").returncode == 2
    assert (tmp_path / "learning.csv").read_bytes() == kept
    assert run_cosim(*words, "--seed", "1", "--overwrite").returncode == 0
    assert (tmp_path / "learning.csv").read_bytes() != kept


REPEATED = """
import os, signal, threading
from cosim.core.processes import command_process

try:
    with command_process():
        os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    print(threading.active_count())
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_signal_is_not_raised_once_more_behind_its_command():
    """The thread that would do so has ended: the handlers are the caller's from here on."""
    words = [sys.executable, "-c", REPEATED]
    result = subprocess.run(words, capture_output=True, text=True, check=True)
    assert result.stdout == "1\n"


CAUGHT = """
import os, signal, sys, time, weakref
from cosim.core.processes import command_process

def interrupt(*_):
    os.kill(os.getpid(), signal.SIGINT)

class Thing:
    pass

with command_process():
    try:
        {where}
        time.sleep(60.0)
    except KeyboardInterrupt:
        print("caught")
sys.exit(7)
"""
WHERE = {
    "in a text": "exec('interrupt()')",
    "in a callback": "thing = Thing(); seen = weakref.ref(thing, interrupt); del thing",
}


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("where", WHERE)
def test_an_interruption_that_is_caught_leaves_the_exit_code(where, tmp_path):
    (tmp_path / "caught.py").write_text(CAUGHT.format(where=WHERE[where]))
    words = [sys.executable, "-m", "caught"]
    result = subprocess.run(words, check=False, cwd=tmp_path, capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr) == (7, "caught\n", "")
