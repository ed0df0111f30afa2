"""What users bring along may fail in any way: one line that names it and the line at fault."""

import sys

import pytest

from controllers.factories import build_controller
from cosim import Scenario
from cosim.core.errors import ControllerLookupError
from learning.algorithm import load_algorithm
from learning.errors import AlgorithmLookupError
from tests.helpers.command import run_cosim

PAPER = Scenario.load("paper")
MODULES = {
    "exits": "raise SystemExit(0)",
    "is no Python": "def",
    "imports what is not there": "import no_such_module_at_all",
    "raises with lines": "raise ValueError('a\\nb\\nc')",
    "is not UTF-8": "# \udcff",
}


@pytest.fixture
def module(tmp_path, monkeypatch, request):
    name = f"plugin_{abs(hash(request.node.name))}"
    path = tmp_path / f"{name}.py"
    monkeypatch.syspath_prepend(str(tmp_path))

    def write(text):
        path.write_bytes(text.encode(errors="surrogateescape"))
        return name

    yield write
    sys.modules.pop(name, None)


@pytest.mark.parametrize("text", MODULES)
def test_a_module_that_fails_is_named(module, text):
    with pytest.raises(ControllerLookupError, match="cannot be imported") as caught:
        build_controller(f"{module(MODULES[text])}:Thing", PAPER)
    assert "\n" not in str(caught.value)


def test_an_algorithm_whose_module_fails_is_named(module):
    with pytest.raises(AlgorithmLookupError, match="cannot be imported"):
        load_algorithm(f"{module('raise SystemExit(0)')}:Thing")


def test_a_misspelt_class_module_or_file_is_told_its_likely_name(tmp_path, monkeypatch):
    (tmp_path / "own_search.py").write_text("class Helper: pass\nclass OwnSearch: pass\n")
    monkeypatch.chdir(tmp_path)
    for given, hint in (
        (
            "own_search:OwnSerch",
            "no attribute 'OwnSerch' (did you mean 'OwnSearch'?)",
        ),
        ("own_serch:OwnSearch", "no module 'own_serch' in"),
        ("own_serch:OwnSearch", "(did you mean 'own_search'?)"),
        ("own_search.py", "give its class, own_search:OwnSearch,"),
    ):
        with pytest.raises(AlgorithmLookupError) as caught:
            load_algorithm(given)
        assert hint in str(caught.value) and "importlib" not in str(caught.value)


def test_a_controller_that_fails_in_the_loop_is_told_where(tmp_path):
    (tmp_path / "broken.py").write_text(
        "class Broken:\n"
        "    def reset(self): pass\n"
        "    def prepare(self): pass\n"
        "    def feedback(self, s, a=None): return 1 / 0\n"
        "def make(scenario): return Broken()\n"
    )
    words = ["simulate", "-c", "broken:make", "-n", "10", "--out", "out"]
    done = run_cosim(*words, folder=tmp_path, env={"TMPDIR": str(tmp_path)})
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    place = f"{tmp_path / 'broken.py'}:4, in feedback"
    assert f"error: {place}: ZeroDivisionError: division by zero" in done.stderr
    assert "maintainers" not in done.stderr and not list(tmp_path.glob("cosim-report-*"))
    assert not (tmp_path / "out").exists()
