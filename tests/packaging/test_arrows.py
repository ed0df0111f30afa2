"""Imports run one way: between the packages as designed, between files in no circle."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("fmus", "cosim", "controllers", "learning")
MAY = {
    "fmus": set(),
    "cosim": {"fmus", "controllers", "learning"},
    "controllers": {"cosim"},
    "learning": {"controllers", "cosim"},
}
"""What a package may import of the others; no file imports itself in a circle."""
HIDDEN = {"controllers": ("cosim.plant", "fmus")}
"""A controller does not see the plant."""
GROUND = (
    "comparison", "environment", "errors", "files", "modules", "plugins", "processes", "protocols",
    "result", "scenario", "simulation", "statistics", "trajectory", "validation",
)  # fmt: skip
"""Modules of cosim that all packages may import; they import none of controllers and learning."""
ABOVE = ("controllers", "learning", "cosim.cli", "cosim.evaluation", "cosim.studies")
ONLY = {"rerun": ("cosim.recording",), "fmpy": ("cosim.plant", "fmus", "cosim.cli.fmu")}
"""Third-party packages that only these modules import."""


@cache
def modules():
    """Every file's module name with its path."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            found[".".join(path.relative_to(ROOT).with_suffix("").parts)] = path
    return found


@cache
def imported(path):
    """Modules that a file imports anywhere in it, for types only too, as full names."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            full = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in modules() else node.module for name in full}
    return names


def test_a_package_imports_only_those_it_may():
    known = modules()
    for name, path in known.items():
        package = name.partition(".")[0]
        found = imported(path)
        others = {other.partition(".")[0] for other in found} & set(PACKAGES)
        assert others - {package} <= MAY[package], name
        assert not [other for other in found if other.startswith(HIDDEN.get(package, ()))], name


def test_the_ground_knows_nobody_who_stands_on_it():
    known = modules()
    for name in GROUND:
        found = imported(known[f"cosim.{name}"])
        assert not [other for other in found if other.startswith(ABOVE)], name


@pytest.mark.parametrize("library", ONLY)
def test_a_library_of_one_room_is_imported_nowhere_else(library):
    known = modules()
    users = [
        name
        for name, path in known.items()
        if any(other.partition(".")[0] == library for other in imported(path))
    ]
    assert users
    assert [name for name in users if not name.startswith(ONLY[library])] == []


def graph(known):
    """Imports between files; a package's face only hands names on and is left out."""
    files = {n for n in known if not n.endswith("__init__")}
    return {name: imported(known[name]) & files - {name} for name in files}


def test_no_file_imports_itself_in_a_circle():
    TopologicalSorter(graph(modules())).prepare()
