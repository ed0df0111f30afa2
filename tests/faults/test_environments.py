"""Training and evaluation give the same bytes whatever the environment that they run in."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow
TRAIN = "-a q-learning -n 300 --log-every 100 --evaluate-every 300 --checkpoint-every 300"
COMMANDS = {
    "train": (
        ["train", *TRAIN.split(), "--evaluation-seeds", "1", "--evaluation-steps", "20"],
        ("learning.csv", "parameters.toml"),
    ),
    "evaluate": (["evaluate", "--seeds", "2", "-n", "60", "--jobs", "1"], ("evaluation.csv",)),
}
GONE = None
ENVIRONMENT = {
    "PYTHONHASHSEED": "4294967295",
    "OMP_NUM_THREADS": "3",
    "OPENBLAS_NUM_THREADS": "3",
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONCOERCECLOCALE": "0",
    "TZ": "Pacific/Kiritimati",
    "HOME": GONE,
    "XDG_CACHE_HOME": GONE,
    "PATH": "/nonexistent",
}
"""All at once, to cost one run; where the bytes differ, leave out one after the other."""


def results(folder, command, values, options=(), umask=-1):
    """Bytes of the command's result files, run in an environment with these values."""
    words, files = COMMANDS[command]
    environment = os.environ | {"COSIM_CACHE": str(folder.parent / "cache")} | values
    folder.mkdir()
    done = subprocess.run(
        [sys.executable, *options, "-m", "cosim", *words, "--out", str(folder / "a b θ")],
        cwd=folder,
        env={name: value for name, value in environment.items() if value is not GONE},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
        umask=umask,
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    return [(folder / "a b θ" / name).read_bytes() for name in files]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_bytes_are_the_same_in_another_environment(tmp_path, command):
    usual = results(tmp_path / "usual", command, {})
    assert results(tmp_path / "other", command, ENVIRONMENT, ["-OO"], 0o077) == usual
