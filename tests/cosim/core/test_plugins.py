"""Plug-ins by name from the user's folders, and files that hide our packages."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from controllers.factories import build_controller
from cosim import Scenario

ROOT = Path(__file__).parents[3]
PAPER = Scenario.load("paper")
CONTROLLER = (
    "from {helper} import HORIZON\n"
    "class Mine:\n"
    "    def reset(self): pass\n"
    "    def prepare(self): pass\n"
    "    def feedback(self, s, a=None): return HORIZON\n"
    "def make(scenario):\n    import {lazy}\n    return Mine()\n"
)


@pytest.fixture
def plugin(tmp_path, monkeypatch, request):
    """A module with a helper that it imports and one that its factory imports."""
    name = f"mine_{abs(hash(request.node.name))}"
    monkeypatch.chdir(tmp_path)
    words = {"helper": f"{name}_helper", "lazy": f"{name}_lazy"}
    (tmp_path / f"{name}.py").write_text(CONTROLLER.format(**words))
    (tmp_path / f"{name}_helper.py").write_text("HORIZON = 3\n")
    (tmp_path / f"{name}_lazy.py").write_text("")

    def forget():
        for module in [module for module in sys.modules if module.startswith(name)]:
            del sys.modules[module]

    yield name, forget
    forget()


def test_a_factory_of_the_working_directory_is_found_and_the_import_path_is_as_before(plugin):
    name, _ = plugin
    path, finders = list(sys.path), list(sys.meta_path)
    controller = build_controller(f"{name}:make", PAPER)
    assert controller.feedback([0.0, 0.0]) == 3
    assert controller.name == f"{name}:make"
    assert (sys.path, sys.meta_path) == (path, finders)


@pytest.mark.parametrize("package", [".py", ""])
def test_the_working_directory_hides_none_of_our_packages(tmp_path, package):
    (tmp_path / "learning").mkdir() if not package else (tmp_path / "learning.py").touch()
    (tmp_path / "mine.py").write_text("import learning\nfound = learning.__file__\n")
    code = (
        "from cosim.core.modules import load_plugin; "
        "print(load_plugin('mine:found', 'it', OSError))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert Path(done.stdout.strip()) == ROOT / "learning" / "__init__.py"


@pytest.mark.parametrize(
    ("name", "kind"), [("controllers", "file"), ("fmus", "package"), ("learning", "file")]
)
@pytest.mark.parametrize("way", ["python -m cosim", "import cosim"])
def test_a_file_that_hides_a_package_is_one_line_that_names_both(tmp_path, name, kind, way):
    path = tmp_path / f"{name}.py" if kind == "file" else tmp_path / name
    if kind == "file":
        path.touch()
    else:
        path.mkdir()
    if kind == "package":
        (path / "__init__.py").touch()
    words = ["-m", "cosim", "--help"] if way.startswith("python") else ["-c", "import cosim"]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    done = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False,
        env=environment,
    )  # fmt: skip
    line = done.stderr.strip().splitlines()[-1]
    assert str(path) in line
    assert f"'{name}'" in line
    if way.startswith("python"):
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
