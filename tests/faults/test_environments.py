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
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
GONE = None
ENVIRONMENTS = {
    "hash seed 4294967295": {"PYTHONHASHSEED": "4294967295"},
    "three threads": dict.fromkeys(THREADS, "3"),
    "C locale": {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "a locale with decimal commas": {"LC_ALL": "de_DE.UTF-8"},
    "another time zone": {"TZ": "Pacific/Kiritimati"},
    "no HOME": {"HOME": GONE, "XDG_CACHE_HOME": GONE, "XDG_CONFIG_HOME": GONE},
    "no PATH": {"PATH": "/nonexistent"},
    "development mode": {"PYTHONDEVMODE": "1", "PYTHONWARNINGS": "default"},
}
CASES = {name: (values, [], None) for name, values in ENVIRONMENTS.items()}
CASES |= {"-OO": ({}, ["-OO"], None), "umask 077": ({}, [], 0o077)}


def results(folder, command, values=None, options=(), umask=None):
    """Bytes of the command's result files, run in an environment with these values."""
    words, files = COMMANDS[command]
    environment = os.environ | {"COSIM_CACHE": str(folder.parent / "cache")} | (values or {})
    done = subprocess.run(
        [sys.executable, *options, "-m", "cosim", *words, "--out", str(folder / "a b θ")],
        cwd=folder,
        env={name: value for name, value in environment.items() if value is not GONE},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
        umask=-1 if umask is None else umask,
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    return [(folder / "a b θ" / name).read_bytes() for name in files]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    found = {}
    for command in COMMANDS:
        (folder / command).mkdir()
        found[command] = results(folder / command, command)
    return found


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("case", CASES)
def test_the_bytes_are_the_same(tmp_path, reference, command, case):
    values, options, umask = CASES[case]
    (tmp_path / "run").mkdir()
    assert results(tmp_path / "run", command, values, options, umask) == reference[command]
