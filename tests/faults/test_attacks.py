"""What plug-ins, names, files and comparisons may be made to do: one line, or nothing wrong."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from cosim import Decision, FmuPlant, Scenario, simulate
from cosim.comparison import compare, load_run
from cosim.core.errors import CosimError, StudyError
from cosim.core.files import check_target, protect, write_atomically
from cosim.studies.run import Run
from tests.helpers.command import run_cosim
from tests.helpers.loop import Proportional

PAPER = Scenario.load("paper")
ROOT = str(Path(__file__).parents[2])


@pytest.fixture(scope="module")
def plant():
    with FmuPlant(PAPER) as plant:
        yield plant


class Plugin:
    """A controller whose `feedback` is a function of the sample's number and the state."""

    def __init__(self, answer):
        self._answer, self._k = answer, -1

    def reset(self):
        pass

    def prepare(self):
        self._k += 1

    def feedback(self, s, a=None):
        return self._answer(self._k, s)


# A recorder, so that predictions are looked at.
KEEP = SimpleNamespace(start=lambda *_: None, record=lambda *_: None, close=lambda: None)


def one_line(error):
    assert "\n" not in str(error.value)
    return str(error.value)


# What a plug-in gives back ----------------------------------------------------------------------

GOOD = [200.0, 200.0]
ACTIONS = {
    "None": None,
    "text": "200 200",
    "long": np.array([200.0] * 3),
    "column": np.array([GOOD]).T,
    "NaN": np.array([np.nan, 200.0]),
}


@pytest.mark.parametrize("kind", ACTIONS)
def test_an_action_of_a_wrong_kind_shape_or_value_is_one_line(plant, kind):
    with pytest.raises(CosimError) as error:
        simulate(plant, Plugin(lambda k, s: Decision(ACTIONS[kind])), 2, 0)
    assert "action" in one_line(error)


def test_what_is_no_solution_is_one_line_and_no_failure_to_solve(plant):
    with pytest.raises(CosimError, match="no solution") as error:
        simulate(plant, Plugin(lambda k, s: np.array(GOOD)), 2, 0)
    one_line(error)


def test_a_prediction_that_changes_its_shape_is_one_line(plant):
    def answer(k, s):
        states, actions = np.zeros((11 + k, 2)), np.zeros((10, 2))
        return Decision(np.array(GOOD), predicted_states=states, predicted_actions=actions)

    with pytest.raises(CosimError, match="prediction") as error:
        simulate(plant, Plugin(answer), 3, 0, recorder=KEEP)
    one_line(error)


# What a plug-in is given ------------------------------------------------------------------------


def test_the_state_that_a_controller_reads_cannot_be_written(plant):
    def answer(k, s):
        s[:] = 0.0
        return Decision(np.array(GOOD))

    with pytest.raises(ValueError, match="read-only"):
        simulate(plant, Plugin(answer), 2, 0)


@pytest.mark.parametrize("name", ["s", "a", "next_s"])
def test_what_a_rule_observes_cannot_be_written(name):
    from learning.algorithm import load_algorithm
    from learning.training_run import begin_training
    from tests.helpers.training import make_run

    run = make_run(samples=20)
    with FmuPlant(PAPER) as plant:
        loop = begin_training(run, load_algorithm(run.algorithm), plant)
        transition, _ = loop.next()
    with pytest.raises(ValueError, match="read-only"):
        getattr(transition, name)[0] = 0.0


# Names ------------------------------------------------------------------------------------------

NAMES = ["..", "", "../a", "C:\\a"]


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_leads_elsewhere_is_refused_for_scenarios_and_cases(name):
    for scenario, case in ((name, "q"), ("paper", name)):
        with pytest.raises(StudyError):
            Run(SimpleNamespace(scenario=SimpleNamespace(name=scenario)), case, {}, {})


# Files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "code"),
    [
        ("replace", errno.EACCES),  # Windows, of a file that another process has open
        ("open", errno.ENOSPC),  # a full disk
    ],
)
def test_a_file_system_that_says_no_leaves_the_old_file_and_no_other(
    tmp_path, monkeypatch, call, code
):
    path = tmp_path / "result.csv"
    path.write_text("old")

    def refuse(self, *_, **__):
        raise OSError(code, os.strerror(code), str(self))

    with monkeypatch.context() as context:
        context.setattr(Path, call, refuse)
        with pytest.raises(OSError, match=os.strerror(code)) as error:
            write_atomically(path, "new")
    assert error.value.filename == str(path)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["result.csv"]


LINKS = {
    "itself": lambda path: path,
    "a symbolic link": lambda path: linked(path, os.symlink),
    "a hard link": lambda path: linked(path, os.link),
}


def linked(path, make):
    make(path, link := path.with_name("link"))
    return link


@pytest.mark.parametrize("way", LINKS)
def test_an_input_is_never_replaced_whatever_it_is_called(tmp_path, way):
    path = tmp_path / "theta.toml"
    path.touch()
    protect([path])
    try:
        with pytest.raises(FileExistsError, match="input of this command"):
            check_target(LINKS[way](path))
    finally:
        protect([])


@pytest.mark.parametrize(
    "words",
    [
        "compare a b --record a/trajectory.csv",
        "train -a q-learning -n 200 --start out/parameters.toml --out out --overwrite",
        "export out/parameters.toml --local --out out/parameters.toml",
    ],
)
def test_no_command_writes_in_the_place_of_what_it_reads(cosim, tmp_path, runs, words):
    from controllers.factories import naive

    (tmp_path / "out").mkdir()
    naive(PAPER).parameters.save(tmp_path / "out" / "parameters.toml")
    (tmp_path / "mine.toml").write_text('extends = "paper"\n')
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    code, _, err = cosim(*words.split())
    assert code == 2
    assert "input of this command" in err
    assert before == {path: path.read_bytes() for path in before}


# Comparisons ------------------------------------------------------------------------------------


@pytest.fixture
def runs(plant, tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        simulate(plant, Proportional(PAPER), 6, 0).write_csv(tmp_path / name / "trajectory.csv")
    return tmp_path


def cell(row, name, value):
    def change(table):
        table.loc[row, name] = value(table.loc[row, name]) if callable(value) else value
        return table

    return change


CHANGES = {
    "a unit": lambda table: table.rename(columns={"X2 [%]": "X2 [1]"}),
    "a doubled column": lambda table: pd.concat([table["X2 [%]"], table], axis=1),
    "the columns' order": lambda table: table[["P2 [kPa]", *table.columns.drop("P2 [kPa]")]],
    "one bit": cell(2, "X2 [%]", lambda text: repr(float(np.nextafter(float(text), 1e9)))),
    "an underscore": cell(0, "X2 [%]", "2_5.0"),
    "a NaN": cell(2, "X2 [%]", ""),
    "a row less": lambda table: table[:-1],
    "a status": cell(2, "status", "fallback"),
    "a column less": lambda table: table.drop(columns="X2 [%]"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_comparison_sees_every_change(runs, what):
    path = runs / "b" / "trajectory.csv"
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    CHANGES[what](table).to_csv(path, index=False)
    try:
        found = compare(load_run(runs / "a"), load_run(runs / "b"))
    except CosimError as error:
        assert "\n" not in str(error)
    else:
        assert not found.equal
        assert found.lines()


# What a plug-in does to its process -------------------------------------------------------------

ENDS = {
    "sys.exit(0)": ("sys.exit(0)", 2, "exit(0)"),
    "a closed pipe": ("raise BrokenPipeError", 2, "pipe"),
    "no Exception": ("raise BaseException('x')", 2, "in feedback: BaseException: x"),
}
PLUGIN = """\
import sys
from tests.helpers.loop import Proportional

class Mine(Proportional):
    def feedback(self, s, a=None):
        {body}
        return super().feedback(s)

def make(scenario):
    return Mine(scenario)
"""
FAST = {"sys.exit(0)"}


@pytest.mark.parametrize(
    "what", [pytest.param(what, marks=[] if what in FAST else pytest.mark.slow) for what in ENDS]
)
def test_exit_code_0_means_results_whatever_a_plug_in_raises(tmp_path, what):
    body, code, words = ENDS[what]
    (tmp_path / "mine.py").write_text(PLUGIN.format(body=body))
    done = run_cosim("simulate", "-c", "mine:make", "-n", 2, "--out", "out", folder=tmp_path,
                     env={"TMPDIR": str(tmp_path), "PYTHONPATH": ROOT})  # fmt: skip
    assert done.returncode == code, done.stderr
    assert not (tmp_path / "out" / "summary.json").exists()
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("error: ") == 1
