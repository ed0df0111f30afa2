"""What a command starts ends with it, whatever ends the command itself."""

import os
import signal
import subprocess
import sys
import time

import pytest

from cosim.lifetime import unwinding_on_signals
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


LOST = """
import sys, time
from cosim import lifetime
from cosim.lifetime import Terminated, unwinding_on_signals, unwound

lifetime.AGAIN = 0.2

class Slow:
    def __del__(self):  # what is raised in here is lost
        print("ready", flush=True)
        time.sleep(60)

sys.unraisablehook = lambda _: print("lost", flush=True)
with unwinding_on_signals():
    try:
        slow = Slow()
        del slow
        time.sleep(60)
    except (KeyboardInterrupt, Terminated) as error:
        try:
            time.sleep(0.5)  # the signal comes again, and is not raised again
            {}["unwinding"]
        except KeyError:
            time.sleep(0.5)
        unwound()
        print(type(error).__name__)
time.sleep(0.5)
"""


@pytest.mark.parametrize(
    ("number", "word"), [(signal.SIGINT, "KeyboardInterrupt"), (signal.SIGTERM, "Terminated")]
)
def test_a_signal_whose_exception_was_lost_comes_again_and_unwinds_once(number, word):
    with subprocess.Popen(
        [sys.executable, "-c", LOST], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        assert process.communicate(timeout=30) == (f"lost\n{word}\n", "")


def test_a_second_ctrl_c_ends_an_unwinding_that_hangs():
    program = (
        "import time\n"
        "from cosim.lifetime import unwinding_on_signals\n"
        "with unwinding_on_signals():\n"
        "  try:\n    print('ready', flush=True)\n    time.sleep(60)\n"
        "  finally:\n    print('unwinding', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        for word in (b"ready\n", b"unwinding\n"):
            assert process.stdout.readline() == word
            process.send_signal(signal.SIGINT)
        assert process.wait(30) in (-signal.SIGINT, 130)


def test_a_background_job_goes_on_ignoring_ctrl_c():
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "from cosim.lifetime import unwinding_on_signals\n"
        "with unwinding_on_signals():\n"
        "    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_ctrl_c_does_not_reach_what_is_started_out_of_its_reach():
    program = (
        "import subprocess, sys\n"
        "from cosim.lifetime import out_of_reach_of_ctrl_c\n"
        "with out_of_reach_of_ctrl_c():\n"
        "    child = subprocess.Popen([sys.executable, '-c', 'print(1); input(); print(2)'],\n"
        "        stdin=subprocess.PIPE, text=True)\n"
        "try:\n    print('ready', flush=True)\n    child.wait()\n"
        "except KeyboardInterrupt:\n    child.communicate('go on\\n')\n"
        "sys.exit(child.returncode)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-uc", program], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        os.killpg(process.pid, signal.SIGINT)  # also while the child's Python is starting
        assert process.communicate(timeout=30)[0] == "1\n2\n"
        assert process.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_command_has_ended_changes_nothing(number):
    program = (
        "import atexit, sys, time\n"
        "from cosim.cli import main\n"
        "atexit.register(lambda: (print('ending', flush=True), time.sleep(0.5)))\n"
        "sys.argv[1:] = ['--help']\n"
        "main()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        while process.stdout.readline() != "ending\n":
            pass
        process.send_signal(number)
        assert process.communicate(timeout=30) == ("", "")
    assert process.returncode == 0


def test_the_handlers_of_before_are_put_back():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with unwinding_on_signals():
        assert signal.getsignal(signal.SIGTERM) is not before[signal.SIGTERM]
    assert before == {number: signal.getsignal(number) for number in before}
