"""What a result was made with: versions, and hashes of code, plant and controller."""

from __future__ import annotations

import hashlib
import inspect
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from cosim.protocols import Controller

DISTRIBUTIONS = ("rti-cosim", "casadi", "daqp", "fmpy", "numpy", "proxsuite", "scipy")
PACKAGES = ("fmus", "cosim", "controllers")
# Nothing that these folders hold bears on an indicator.
ASIDE = {"cli", "figures", "recording", "__pycache__"}


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
def code_hash(packages: tuple[str, ...] = PACKAGES) -> str:
    """First 16 hex digits of the SHA-256 of the code that results depend on, FMUs included."""
    digest = hashlib.sha256()
    for package in packages:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            continue
        root = Path(spec.origin).parent
        for path in sorted(root.rglob("*")):
            relative = path.relative_to(root)
            wanted = path.suffix in (".py", ".toml", ".fmu") and not ASIDE & set(relative.parts)
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


def parameters_hash(controller: Controller) -> str:
    """The hash of the controller's parameters, empty if it has none."""
    return str(getattr(getattr(controller, "parameters", None), "hash", "") or "")
