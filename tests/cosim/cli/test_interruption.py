"""Ctrl-C and SIGTERM end every command with one line that says how it goes on."""

import os
import signal
import subprocess
import sys

import pytest

from tests.helpers.command import LONG_STUDY, eventually

AGAIN = "; what is finished is kept: the same command goes on from there"
COMMANDS = {
    "simulate": ("simulate -n 5000000", "", ".cosim.lock"),
    "evaluate": ("evaluate --seeds 9999 -n 1000 --jobs 1", "", ".cosim.lock"),
    "evaluate --jobs": ("evaluate --seeds 9999 -n 1000 --jobs 2", "", ".cosim.lock"),
    "study": ("study run study.toml --jobs 2", AGAIN, "runs/**/*.csv"),
    "train": (
        "train -a q-learning -n 9999999 --checkpoint-every 1000 --log-every 100",
        "; the same command with --resume goes on from {out}/checkpoint.npz",
        "checkpoint.npz",
    ),
}
ENDS = {"SIGINT": ("interrupted", 130), "SIGTERM": ("terminated", 143)}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("command", "number"), [*((command, "SIGINT") for command in COMMANDS), ("train", "SIGTERM")]
)
def test_an_interrupted_command_says_how_it_goes_on(tmp_path, command, number):
    (tmp_path / "study.toml").write_text(LONG_STUDY)
    words, how, file = COMMANDS[command]
    word, code = ENDS[number]
    with subprocess.Popen(
        [sys.executable, "-m", "cosim", *words.split(), "--out", "out"],
        cwd=tmp_path,
        # A signal may come between a file's opening and its `with`: not what is tested here.
        env=os.environ | {"COSIM_COMPILE": "never", "PYTHONWARNINGS": "ignore::ResourceWarning"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert eventually(lambda: any((tmp_path / "out").glob(file)), 120)
        try:
            if number == "SIGINT":  # as a terminal sends it, to all in the foreground
                os.killpg(process.pid, signal.SIGINT)
            else:
                process.terminate()
            _, said = process.communicate(timeout=120)
        finally:
            process.kill()
    out = (tmp_path / "out").resolve()
    assert (process.returncode, said) == (code, f"{word}{how.format(out=out)}\n")


@pytest.mark.parametrize("words", ["export tuned -o ", "view ", "simulate -c ", ""])
def test_an_empty_word_is_refused_by_every_command(cosim, words, tmp_path):
    code, out, err = cosim(*words.split(" "))
    assert (code, out) == (2, "")
    assert "is empty: give one, or leave it out" in err
    assert list(tmp_path.iterdir()) == []
