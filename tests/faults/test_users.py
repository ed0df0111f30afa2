"""Two users on one machine, in one folder: what one left keeps the other neither out nor fooled."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.cosim.core.test_processes import HOLD

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not hasattr(os, "geteuid") or os.geteuid() != 0 or not shutil.which("setpriv"),
        reason="needs root and setpriv",
    ),
]
ROOT = str(Path(__file__).parents[2])
ANNE, BERT = 4001, 4002


def python(user, *words):
    """Python's command line with these words, as another user."""
    return ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", sys.executable,
            *map(str, words)]  # fmt: skip


@pytest.fixture
def shared():
    """A folder that both can enter and write; pytest's own are closed to them."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        able = python(ANNE, "-c", "import cosim.cli.simulate")
        if subprocess.run(able, cwd=ROOT, stderr=subprocess.DEVNULL, check=False).returncode:
            pytest.skip("other users cannot read Python or this checkout")
        yield Path(folder)


def simulate(folder, user, **env):
    words = python(user, "-m", "cosim", "simulate", "-n", 5, "--out", folder)
    env = os.environ | {"PYTHONPATH": ROOT, "HOME": str(folder.parent / str(user)), **env}
    return subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True, check=False)


def owners(folder):
    return {path.stat().st_uid for path in folder.rglob("*")}


def test_a_lock_of_another_user_is_obeyed_and_ends_with_its_process(shared):
    words = python(ANNE, "-c", HOLD, shared)
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        refused = simulate(shared, BERT)
        holder.kill()
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert f"written by process {holder.pid} on " in refused.stderr
    assert simulate(shared, BERT).returncode == 0
    assert owners(shared) == {BERT}
    assert not list(shared.glob(".*"))
    assert simulate(shared, ANNE).returncode == 0


def test_files_that_the_folder_protects_from_another_user_stay_as_they_are(shared):
    assert simulate(shared, ANNE).returncode == 0
    shared.chmod(0o1777)
    before = {path: path.read_bytes() for path in shared.iterdir()}
    refused = simulate(shared, BERT)
    assert (refused.returncode, refused.stderr.count("error: ")) == (2, 1)
    assert str(shared / "trajectory.csv") in refused.stderr
    assert before == {path: path.read_bytes() for path in shared.iterdir()}


def test_code_is_not_loaded_from_another_users_cache(shared):
    caches = {"COSIM_CACHE": str(shared / "cache")}
    (shared / "cache").mkdir()
    os.chown(shared / "cache", ANNE, ANNE)
    for user in (ANNE, BERT):
        (out := shared / str(user)).mkdir(mode=0o777)
        out.chmod(0o777)
        assert simulate(out, user, **caches).returncode == 0
        assert owners(shared / "cache") == {ANNE}
