"""What a result was made with: versions, and hashes of code, plant and controller."""

from __future__ import annotations

import hashlib
import inspect
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from cosim.plugins import OURS
from cosim.protocols import Controller

DISTRIBUTIONS = ("rti-cosim", "casadi", "daqp", "fmpy", "numpy", "proxsuite", "scipy")
EVALUATING = tuple(package for package in OURS if package != "learning")
"""Packages that decide what a controller does on a plant."""
SUFFIXES = (".py", ".toml", ".fmu", ".npz")
# Nothing that these folders hold bears on an indicator.
ASIDE = {"cli", "figures", "recording", "experiments", "__pycache__"}


@cache
def versions() -> str:
    """Versions of Python and of the distributions that results depend on, as one line."""
    found = [f"python {platform.python_version()}"]
    for name in DISTRIBUTIONS:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return "; ".join(found)


@cache
def code_hash(packages: tuple[str, ...] = EVALUATING) -> str:
    """First 16 hex digits of the SHA-256 of the code that results depend on, FMUs included."""
    digest = hashlib.sha256()
    for package in packages:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            continue
        root = Path(spec.origin).parent
        for path in sorted(root.rglob("*")):
            relative = path.relative_to(root)
            wanted = path.suffix in SUFFIXES and not ASIDE & set(relative.parts)
            if wanted and path.is_file():
                digest.update(f"{package}/{relative.as_posix()}\0".encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def controller_hash(controller: Controller) -> str:
    """First 16 hex digits of a hash of the module that defines the controller's class.

    So a cached result of a user's controller is not taken for one of its edited version. What a
    controller reads from elsewhere must be in its `parameters.hash`.
    """
    try:
        source = inspect.getsource(inspect.getmodule(type(controller)) or type(controller))
    except (OSError, TypeError):
        source = type(controller).__qualname__
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def source_hashes(target: str) -> dict[str, str]:
    """Hashes by name of the foreign files behind a parameters file's path or a `module:attribute`.

    A module's package counts as a whole, a module without one alone; this package's own modules
    are in `code_hash`. What cannot be found is left to whoever imports it.
    """
    if (path := Path(target)).is_file():
        return {path.name: _digest([path])}
    module, colon, _ = target.partition(":")
    package = module.partition(".")[0]
    if not colon or package in OURS:
        return {}
    try:
        top, own = find_spec(package), find_spec(module)
    except (ImportError, ValueError):
        return {}
    if top is not None and top.origin is not None and top.submodule_search_locations:
        root = Path(top.origin).parent
        return {package: _digest(sorted(root.rglob("*.py")))}
    if own is None or own.origin is None:
        return {}
    return {module: _digest([Path(own.origin)])}


def _digest(paths: list[Path]) -> str:
    """First 16 hex digits of the SHA-256 of files, names apart."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def parameters_hash(controller: Controller) -> str:
    """The hash of the controller's parameters, empty if it has none."""
    return str(getattr(getattr(controller, "parameters", None), "hash", "") or "")
