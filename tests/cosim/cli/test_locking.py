"""One writer per folder, and no folder that mixes two runs."""

import json
import re
import subprocess
import sys

import pytest
import rerun.blueprint as rrb

from cosim.cli import locking
from cosim.cli.output import open_folder, output
from cosim.errors import CosimError
from cosim.recording.stream import Stream
from tests.helpers.command import run_cosim

HOLD = (
    "import sys, time\n"
    "from pathlib import Path\n"
    "from cosim.cli.locking import hold\n"
    "hold(Path(sys.argv[1])); print('held', flush=True); time.sleep(600)\n"
)
TRAIN = ["train", "-a", "q-learning", "--scenario", "paper", "--json"]
SHORT = ["--log-every", "100", "--evaluate-every", "300", "--evaluation-steps", "10"]
EVERY = ["--evaluation-seeds", "1", "--checkpoint-every", "300"]


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


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "-n", "10"],
        pytest.param(["simulate", "-n", "10", "--record"], marks=SLOW),
        pytest.param(["evaluate", "--controllers", "naive", "--seeds", "1"], marks=SLOW),
        pytest.param(["train", "-a", "q-learning", "-n", "10"], marks=SLOW),
    ],
)
def test_a_folder_that_is_being_written_is_refused(holder, tmp_path, command):
    done = run_cosim(*command, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert re.search(
        rf"is being written by process {holder.pid} on \S+ \(.*\) since \S+; wait", done.stderr
    )


@SLOW
def test_the_lock_of_a_killed_process_is_given_back(holder, tmp_path):
    holder.kill()
    holder.wait()
    assert run_cosim("simulate", "-n", "10", "--out", tmp_path / "out").returncode == 0
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert not left & {locking.LOCK, locking.HOLDER}


def test_a_command_leaves_no_lock_behind_whether_it_succeeds_or_fails(tmp_path):
    def command():
        with output(False):
            open_folder(tmp_path)
            assert (tmp_path / locking.LOCK).exists()
            raise CosimError("failed")

    with pytest.raises(CosimError):
        command()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_may_be_opened_twice_by_its_holder(tmp_path):
    with output(False):
        open_folder(tmp_path)
        open_folder(tmp_path)


def test_a_damaged_note_of_the_holder_does_not_hide_that_there_is_one(holder, tmp_path):
    (tmp_path / "out" / locking.HOLDER).write_text("{")
    with pytest.raises(CosimError, match="is being written by another process"):
        locking.hold(tmp_path / "out")


@SLOW
def test_a_recording_of_another_run_does_not_stand_beside_the_signals(tmp_path):
    assert run_cosim("simulate", "-n", "20", "--record", "--out", tmp_path).returncode == 0
    assert (tmp_path / "run.rrd").exists()
    assert run_cosim("simulate", "-n", "20", "--seed", "1", "--out", tmp_path).returncode == 0
    assert not (tmp_path / "run.rrd").exists()


@SLOW
def test_a_training_is_neither_overwritten_nor_mixed_unless_asked(tmp_path):
    words = [*TRAIN, *SHORT, *EVERY, "--out", tmp_path, "--samples", "300"]
    assert run_cosim(*words).returncode == 0
    kept = (tmp_path / "learning.csv").read_bytes()
    refused = run_cosim(*words, "--seed", "1")
    assert refused.returncode == 2
    assert "--resume" in refused.stderr
    assert "--overwrite" in refused.stderr
    assert (tmp_path / "learning.csv").read_bytes() == kept
    again = run_cosim(*words, "--seed", "1", "--overwrite")
    assert again.returncode == 0
    assert json.loads(again.stdout)["seed"] == 1
    assert (tmp_path / "learning.csv").read_bytes() != kept


def test_two_recordings_of_one_name_do_not_share_a_partial_file(tmp_path):
    empty = rrb.Blueprint()
    first, second = (Stream(tmp_path / "run.rrd", name, empty) for name in "ab")
    assert len(list(tmp_path.glob(".run.*.partial.rrd"))) == 2
    first.discard()
    second.discard()
    assert list(tmp_path.iterdir()) == []
