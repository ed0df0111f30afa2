"""No public name without a docstring, and no field of a documented class without a meaning."""

import ast
import dataclasses
import importlib
import inspect
import pkgutil
import re
import textwrap
from itertools import pairwise
from pathlib import Path

import pytest
from pydantic import BaseModel

from tests.helpers.optional import OPTIONAL

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"
PACKAGES = ("fmus", "cosim", "controllers", "learning")


def modules():
    for package in PACKAGES:
        root = importlib.import_module(package)
        yield package
        for found in pkgutil.walk_packages(root.__path__, f"{package}."):
            if not found.name.endswith("__main__") and found.name not in OPTIONAL:
                yield found.name


def undocumented(module):
    """Public names that the module defines and does not document."""
    if not inspect.getdoc(module):
        yield module.__name__
    for name, item in vars(module).items():
        public = not name.startswith("_") and getattr(item, "__module__", "") == module.__name__
        if not public or not (inspect.isclass(item) or inspect.isfunction(item)):
            continue
        if not (item.__doc__ or "").strip():
            yield f"{module.__name__}.{name}"
        if not inspect.isclass(item):
            continue
        for part, member in vars(item).items():
            function = member.fget if isinstance(member, property) else member
            function = getattr(function, "__func__", getattr(function, "func", function))
            if part.startswith("_") or not inspect.isfunction(function):
                continue
            if not (function.__doc__ or "").strip():
                yield f"{module.__name__}.{name}.{part}"


def fields(kind):
    """Public fields that a dataclass, named tuple or pydantic model itself declares."""
    own = [name for name in inspect.get_annotations(kind) if not name.startswith("_")]
    if dataclasses.is_dataclass(kind):
        return [field.name for field in dataclasses.fields(kind) if field.name in own]
    if issubclass(kind, tuple):
        return [name for name in getattr(kind, "_fields", ()) if name in own]
    if issubclass(kind, BaseModel):
        return [name for name, field in kind.model_fields.items()
                if name in own and not field.description]  # fmt: skip
    return []


def described(kind):
    """Fields with a docstring of their own, below them."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body
    for item, after in pairwise(body):
        is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if isinstance(item, ast.AnnAssign) and is_text:
            yield item.target.id


def without_meaning(module):
    """Fields that neither their class's docstring nor one of their own names."""
    for kind in vars(module).values():
        if not inspect.isclass(kind) or kind.__module__ != module.__name__:
            continue
        for name in set(fields(kind)) - set(described(kind)):
            if not re.search(rf"\b{re.escape(name)}\b", kind.__doc__ or ""):
                yield f"{module.__name__}.{kind.__name__}.{name}"


def in_reference():
    """Modules that the reference pages show."""
    for page in sorted(REFERENCE.glob("*.md")):
        yield from re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE)


def test_every_field_in_the_reference_has_a_meaning():
    found = [importlib.import_module(name) for name in in_reference()]
    assert len(found) > 50
    kinds = [kind for module in found for kind in vars(module).values() if inspect.isclass(kind)]
    assert sum(len(fields(kind)) for kind in kinds) > 250
    assert [name for module in found for name in without_meaning(module)] == []


def test_a_field_without_a_meaning_is_seen(monkeypatch):
    import cosim.protocols

    monkeypatch.setattr(cosim.protocols.Step, "__doc__", "One step: s and stage_cost.")
    assert set(without_meaning(cosim.protocols)) == {
        "cosim.protocols.Step.penalty",
        "cosim.protocols.Step.disturbance",
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_documented(package):
    names = [name for name in modules() if name.split(".")[0] == package]
    missing = [each for name in names for each in undocumented(importlib.import_module(name))]
    assert len(names) > 3
    assert not missing


def test_every_exported_name_is_there():
    for package in PACKAGES:
        module = importlib.import_module(package)
        for name in module.__all__:
            assert getattr(module, name) is not None


def test_the_check_sees_what_is_missing(monkeypatch):
    import cosim.penalty

    monkeypatch.setattr(cosim.penalty.Penalty, "__doc__", None)
    assert "cosim.penalty.Penalty" in set(undocumented(cosim.penalty))
