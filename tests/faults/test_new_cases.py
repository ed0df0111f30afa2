"""Cases beyond those of docs/faults.md: `pytest -m campaign tests/faults` says tried and held."""

import json
import shutil
from pathlib import Path

import pytest

from cosim import FmuPlant, Scenario, simulate
from cosim.comparison import compare, load_run
from cosim.core.errors import CosimError
from tests.cosim.studies.test_study import contents
from tests.helpers.command import run_cosim
from tests.helpers.loop import Proportional
from tests.helpers.toy_study import run_toy

pytestmark = pytest.mark.campaign
PAPER = Scenario.load("paper")
ROOT = str(Path(__file__).parents[2])
CONTROLLER = """
import os, sys
import numpy as np
from tests.helpers.loop import Proportional
class Mine(Proportional):
    def feedback(self, s, a=None):
        {}
        return super().feedback(s)
def make(scenario): return Mine(scenario)
"""


NAMES = ["a\0b", "a\nb", "a\tb", "a:b", "a*b", "a?", 'a"b', "a|b", "<a>", "a.", "a ", " a", "...",
         "CON", "nul.txt", "com1", "x" * 300, "é" * 200, "\u202eabc", "\ud800"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_a_case_of_any_name_is_refused_or_stays_in_its_folder(tmp_path, name):
    out = tmp_path / "deep" / "out"
    try:
        run_toy(out, case=[{"controller": "naive", "name": name}])
    except (CosimError, OSError, ValueError) as error:
        assert "\n" not in str(error)
    else:
        assert len(list(out.glob("runs/paper/*/run.json"))) == 2  # optimal is always there
    assert {path.name for path in tmp_path.iterdir()} <= {"deep"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "trajectory.csv"
    with FmuPlant(PAPER) as plant:
        return simulate(plant, Proportional(PAPER), 6, 0).write_csv(path)


# Of the text of a run: what is replaced, once, by what
EDITS = [("25.0,", "0x19,"), ("25.0,", "2_5.0,"), ("25.0,", "٢٥.0,"), ("25.0,", "inf,"),
         ("25.0,", '"25,0",'), ("25.0,", "much,"), ("25.0,", ","), ("[kPa]", "[KPA]"),
         ("[kPa]", ""), ("X2 [", "X2  ["), ("X2", "x2"), ("time", "# time"), ("\n", "\n\n\0"),
         ("\n", "\r\r\n,"), ("solved", "Solved"), (",solved", ",0,solved"), ("1", "2")]  # fmt: skip


@pytest.mark.parametrize(("old", "new"), EDITS, ids=ascii)
def test_a_comparison_sees_every_edit_of_the_text(run, tmp_path, old, new):
    before = Path(run).read_text()
    assert old in before
    (tmp_path / "trajectory.csv").write_text(before.replace(old, new, 1))
    try:
        assert not compare(load_run(run), load_run(tmp_path)).equal
    except CosimError as error:
        assert "\n" not in str(error)


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "a bit": lambda path: path.write_bytes(b"\0" + path.read_bytes()[1:]),
    "doubled": lambda path: path.write_bytes(path.read_bytes() * 2),
    "gone": Path.unlink,
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "another run's": lambda path: shutil.copy(path.parents[1] / "1" / path.name, path),
    "a link to nothing": lambda path: (path.unlink(), path.symlink_to("nothing")),
}
STORED = ("evaluation.csv", "learning.csv", "parameters.toml", "run.json", "timing.csv")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    run_toy(folder := tmp_path_factory.mktemp("whole"))
    return folder


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", STORED)
def test_a_damaged_file_of_a_finished_study_is_made_again(whole, tmp_path, name, damage):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "runs" / "paper" / "grow(rate=1.0)" / "0" / name
    content = path.read_bytes()
    DAMAGES[damage](path)
    try:
        run_toy(tmp_path)
    except (CosimError, OSError) as error:  # what may be somebody else's is not removed
        assert damage == "a folder" or (name == "run.json" and not path.exists()), error
        assert "\n" not in str(error)
    else:
        assert contents(tmp_path) == contents(whole)
        assert name in ("run.json", "timing.csv") or path.read_bytes() == content


ENDS = ["raise MemoryError", "raise StopIteration", "raise GeneratorExit",
        "raise KeyboardInterrupt", "raise RecursionError", "sys.exit('all is well')",
        "sys.exit(True)", "os.kill(os.getpid(), 15)", "sys.stdout = None"]  # fmt: skip
GOES_ON = ["os.environ.clear()", "print('{}')",
           "os.write(1, b'{}')", "sys.setrecursionlimit(200)",
           "np.random.seed(0); np.seterr(all='raise')", "import gc; gc.disable()",
           "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)"]  # fmt: skip
EITHER = ["import json; json.dumps = None", "os.chdir('/')", "import shutil; shutil.rmtree('out')",
          "os.close(1)", "os.close(2)"]  # fmt: skip


@pytest.mark.parametrize("what", [*ENDS, *GOES_ON, *EITHER])
def test_exit_code_0_means_results_whatever_a_plug_in_does_to_its_process(run, tmp_path, what):
    (tmp_path / "mine.py").write_text(CONTROLLER.replace("{}", what))
    words = ["simulate", "-c", "mine:make", "-n", 6, "--out", "out", "--json"]
    env = {"TMPDIR": str(tmp_path), "PYTHONPATH": ROOT}
    done = run_cosim(*words, timeout=240, folder=tmp_path, env=env)
    assert "Traceback" not in done.stderr
    if done.returncode:
        assert what not in GOES_ON, done.stderr
        assert done.stderr.count("error: ") == 1 or "os.close(2)" in what or done.returncode > 128
    else:
        assert what not in ENDS
        assert compare(load_run(run), load_run(tmp_path / "out")).equal
        assert what == "os.close(1)" or json.loads(done.stdout)["failures"] == 0
