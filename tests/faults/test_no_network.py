"""Without any network every command works, and nothing tries to resolve a name."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.drawing import skip_without_driver

pytestmark = pytest.mark.slow
SCRIPT = Path(__file__).parents[1] / "helpers" / "no_network.py"
COMMANDS = {
    "simulate": ["simulate", "-n", "50", "--record", "--out", "run"],
    "train": ["train", "-a", "fixed", "-n", "500", "--evaluate-every", "1000", "--out", "t"],
    "view": ["view", "run/run.rrd", "--png", "run.png"],
}


def without_network(folder, *command):
    home = folder / "home"
    home.mkdir(exist_ok=True)
    done = subprocess.run(
        ["unshare", "--net", "--mount", sys.executable, SCRIPT, *command],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={key: value for key, value in os.environ.items() if key != "CI"} | {"HOME": str(home)},
    )
    if done.returncode:
        pytest.skip(f"no network namespace to be had here: {done.stderr.strip()[-100:]}")
    return json.loads(done.stdout)


def test_a_name_that_is_asked_for_is_seen(tmp_path):
    script = "import socket\ntry: socket.gethostbyname('asked.example')\nexcept OSError: pass"
    assert without_network(tmp_path, sys.executable, "-c", script)["queries"] == ["asked.example"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_needs_no_network_and_asks_for_no_name(tmp_path, name):
    command = [sys.executable, "-m", "cosim"]
    if name == "view":
        without_network(tmp_path, *command, *COMMANDS["simulate"])
    found = without_network(tmp_path, *command, *COMMANDS[name])
    skip_without_driver(found["stderr"])
    assert found["returncode"] == 0, found["stderr"]
    assert found["queries"] == []
    assert not list((tmp_path / "home").rglob("analytics*"))
