"""What was measured is what was named: content, not names, and never a table of two codes."""

import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from controllers import Parameters, Problem
from cosim import Scenario, evaluate, study
from cosim.core.errors import ControllerLookupError, CosimError, FailedRunsError
from cosim.core.modules import UNKNOWN, import_from, load_plugin
from cosim.identity import changed, code_hash, depends_on
from tests.cosim.core.test_files import HOLD
from tests.helpers.loop import Proportional

ROOT = Path(__file__).parents[2]
PLUG = """
from tests.helpers.loop import Proportional
GAIN = 0.1
class Mine(Proportional):
    def feedback(self, s, a=None):
        return super().feedback(s + GAIN)
def make(scenario): return Mine(scenario)
"""
READER = "from pathlib import Path\n" + PLUG.replace(
    "GAIN = 0.1", "GAIN = float(Path({path!r}).read_text())"
)


def costs(controller, jobs=1, **options):
    return (
        evaluate("paper", {"mine": controller}, 2, 8, jobs=jobs, **options).to_pandas().J.tolist()
    )


@pytest.fixture
def plug(tmp_path, monkeypatch, request):
    """A plug-in's name, its file and a function that edits it, in the working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    name = f"plug_{abs(hash(request.node.name))}"
    path = tmp_path / f"{name}.py"
    path.write_text(PLUG)

    def edit(old="0.1", new="3.0"):
        path.write_text(path.read_text().replace(old, new))

    yield f"{name}:make", path, edit
    for module in [module for module in sys.modules if module.startswith(name)]:
        del sys.modules[module]


class Shifted(Proportional):
    def __init__(self, shift, scenario):
        super().__init__(scenario)
        self.shift = shift

    def feedback(self, s, a=None):
        return super().feedback(s + self.shift)


class Maker:
    def __init__(self, shift):
        self.shift = shift

    def __call__(self, scenario):
        return Shifted(self.shift, scenario)


def closure(shift):
    return lambda scenario: Shifted(shift, scenario)


@pytest.mark.parametrize("kind", [Maker, closure, lambda shift: partial(Shifted, shift)])
def test_a_controller_without_a_name_is_evaluated_as_it_is(kind, tmp_path):
    first, second = (costs(kind(shift), folder=tmp_path) for shift in (0.1, 3.0))
    assert second == costs(kind(3.0)) != first


@pytest.mark.slow
def test_an_edited_plug_in_is_loaded_anew_in_one_process_and_in_many(plug):
    name, path, edit = plug
    before = costs(name)
    changed_at = path.stat().st_mtime_ns
    edit()
    # An edit of the same size within a second: Python would take stored bytecode for current.
    os.utime(path, ns=(changed_at, changed_at))
    after = costs(name)
    assert costs(name, jobs=2) == after != before


def test_a_loaded_object_is_not_mixed_with_the_edited_file(plug, monkeypatch, tmp_path):
    name, _, edit = plug
    monkeypatch.syspath_prepend(tmp_path)
    make = load_plugin(name, "it", ControllerLookupError)
    before = costs(make)
    edit()
    assert costs(make) == before
    with pytest.raises(CosimError, match="other things than") as caught:
        costs(make, jobs=2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("where", ["aid.py", "kit/__init__.py", "kit/tool.py", "of itself"])
def test_an_edit_of_any_python_file_beside_a_plug_in_is_seen(plug, tmp_path, paper, where):
    name, path, _ = plug
    file = path if where == "of itself" else tmp_path / where
    for other in ("aid.py", "kit/__init__.py", "kit/tool.py"):
        (tmp_path / other).parent.mkdir(exist_ok=True)
        (tmp_path / other).touch()
    before = depends_on(paper, name)
    file.write_text(file.read_text() + "# edited\n")
    assert changed(before, depends_on(paper, name)) == [f"plug-in {name.partition(':')[0]}"]


def test_an_edit_of_the_plants_own_model_is_seen(plug, paper):
    name, path, _ = plug
    scenario = paper.replace({"plant": {"model": name}})
    before = depends_on(scenario)
    path.write_text(path.read_text() + "# edited\n")
    assert changed(before, depends_on(scenario)) == [f"plug-in {name.partition(':')[0]}"]


def test_two_files_of_one_name_are_refused(plug, tmp_path):
    name, path, _ = plug
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / path.name).write_text(PLUG.replace("0.1", "3.0"))
    import_from(tmp_path / "other")
    with pytest.raises(CosimError, match="two files have the name") as caught:
        costs(name)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_module_without_a_file_cannot_be_known(plug, paper, monkeypatch):
    module = type(sys)("typed_in_a_session")
    exec(PLUG, vars(module))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    assert UNKNOWN in depends_on(paper, "typed_in_a_session:make").values()
    lines = []
    for _ in range(2):
        run_study({"controller": "typed_in_a_session:make"}, "out", lines)
    assert any("cannot be known" in line for line in lines)


# Studies ----------------------------------------------------------------------------------------


def run_study(case, out, lines, **changes):
    document = {
        "schema": 1,
        "name": "t",
        "scenarios": ["paper"],
        "evaluation": {"seeds": 2, "steps": 8},
        "case": [case | {"name": "x"}],
    } | changes
    found = study(document, out, progress=lambda done, runs, line: lines.append(line))
    return found.evaluation[found.evaluation.case == "x"].J.tolist()


@pytest.mark.slow
def test_theta_that_is_replaced_during_a_study_is_the_one_that_was_planned(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = Parameters.naive(Problem.from_scenario(Scenario.load("paper")))
    second = first.replace({"x_l": [30.0, 45.0]})

    class Replacing(list):
        def append(self, line):
            second.save("theta.toml")

    first.save("theta.toml")
    disturbed = run_study({"controller": "theta.toml"}, "out", Replacing())
    lines = []
    with_second = run_study({"controller": "theta.toml"}, "out", lines)
    assert "theta.toml changed since these runs; they are done again" in lines
    first.save("theta.toml")
    undisturbed = run_study({"controller": "theta.toml"}, "other", [])
    assert disturbed == undisturbed != with_second


@pytest.mark.slow
def test_a_data_file_that_a_study_names_counts(plug, tmp_path):
    name, path, _ = plug
    path.write_text(READER.format(path=str(tmp_path / "gain.txt")))
    found, lines = [], []
    for text in ("0.1", "3.0", "3.0"):
        (tmp_path / "gain.txt").write_text(text)
        lines.clear()
        found.append(run_study({"controller": name}, "out", lines, depends_on=["gain.txt"]))
    assert found[0] != found[1] == found[2]
    assert not any(line.startswith("x on paper") for line in lines), "the last one was done"
    with pytest.raises(CosimError, match="depends_on: there is no file"):
        run_study({"controller": name}, "out", [], depends_on=["none.txt"])


def test_an_edit_during_a_study_is_refused_by_name(plug):
    name, _, edit = plug

    class Editing(list):
        def append(self, line):
            edit()

    with pytest.raises(FailedRunsError, match="plug-in plug_"):
        run_study({"controller": name}, "out", Editing())


# Places -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_model_beside_its_scenario_is_found_by_workers_from_any_folder(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    (tmp_path / "elsewhere").mkdir()
    name = f"model_{os.getpid()}"
    text = "import controllers.evaporator as e\ndef make(): return e.model()\n"
    (tmp_path / "sub" / f"{name}.py").write_text(text)
    document = f'extends = "paper"\n[controller]\nmodel = "{name}:make"\n'
    (tmp_path / "sub" / "s.toml").write_text(document)
    monkeypatch.chdir(tmp_path / "elsewhere")
    tables = [evaluate("../sub/s.toml", ["naive"], 2, 8, jobs=jobs).to_csv() for jobs in (1, 2)]
    assert tables[0] == tables[1]


@pytest.mark.slow
def test_a_relative_fmu_is_the_same_for_workers(tmp_path, monkeypatch, paper):
    shutil.copy(ROOT / "fmus" / "evaporator.fmu", tmp_path / "mine.fmu")
    monkeypatch.chdir(tmp_path)
    scenario = paper.replace({"plant": {"fmu": "./mine.fmu"}})
    tables = [evaluate(scenario, ["pi"], 2, 8, jobs=jobs).to_csv() for jobs in (1, 2)]
    assert tables[0] == tables[1]


@pytest.mark.parametrize("fmu", ["evaporator", "evaporator_fmi3"])
def test_loading_an_fmu_leaves_the_working_directory_alone(paper, monkeypatch, fmu):
    from cosim import FmuPlant

    def refuse(path):
        raise AssertionError(f"the working directory was changed to {path}")

    monkeypatch.setattr(os, "chdir", refuse)
    with FmuPlant(paper, fmu) as plant:
        plant.reset(1)


def test_a_folder_that_another_process_writes_is_refused(tmp_path):
    words = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(CosimError, match=f"written by process {holder.pid}"):
            costs("pi", folder=tmp_path)
        holder.kill()
    assert costs("pi", folder=tmp_path) == costs("pi")


def test_our_own_code_is_known_by_its_c_too_and_not_by_stored_results(monkeypatch, tmp_path):
    files = {"cosim/a.py": "", "controllers/b.c": "", "fmus/c.h": "", "cosim/results/d.toml": ""}

    def hash_with(edited):
        for name in files:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text("edited" if name == edited else "")
        code_hash.cache_clear()
        return code_hash()

    with monkeypatch.context() as context:
        context.setattr("cosim.identity.ROOT", tmp_path)
        plain = hash_with("")
        assert {name for name in files if hash_with(name) != plain} == {*files} - {
            "cosim/results/d.toml"
        }
    code_hash.cache_clear()


def test_an_object_of_pythons_own_is_loaded_and_never_loaded_anew(monkeypatch, tmp_path, paper):
    """Loaded anew, modules that hold the process's state would be there twice."""
    import json
    import multiprocessing.context
    import warnings

    monkeypatch.chdir(tmp_path)
    before = [json, multiprocessing.context, warnings, sys.modules["numpy"]]
    assert load_plugin("json:loads", "it", ControllerLookupError) is json.loads
    load_plugin("numpy:zeros", "it", ControllerLookupError)
    data = tmp_path / "data.csv"
    for content in ("1", "2"):
        data.write_text(content)
        depends_on(paper, [], files={"data": data})
    names = ("json", "multiprocessing.context", "warnings", "numpy")
    assert [sys.modules[name] for name in names] == before
