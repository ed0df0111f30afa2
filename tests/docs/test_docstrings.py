"""No public name without a docstring."""

import importlib
import inspect
import pkgutil

import pytest

PACKAGES = ("fmus", "cosim", "controllers", "learning")
# Only with the extra that brings the tool that it drives.
OPTIONAL = ("fmus.checks.ecospy_check", "fmus.checks.libcosimpy_check")


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


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_documented(package):
    names = [name for name in modules() if name.split(".")[0] == package]
    missing = [each for name in names for each in undocumented(importlib.import_module(name))]
    assert len(names) > 5
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
