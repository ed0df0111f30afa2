"""Identity of a result: versions, our own code, scenario, FMU, plug-ins and data files."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cosim.core.errors import ControllerLookupError
from cosim.core.modules import (
    ALGORITHMS,
    CONTROLLERS,
    OURS,
    ROOT,
    TARGET,
    code_of,
    forget_users_modules,
    load_plugin,
    registered,
)
from cosim.core.scenario import Scenario
from cosim.plant.fmi import unpack

DISTRIBUTIONS = ("rti-cosim", "casadi", "daqp", "fmpy", "numpy", "proxsuite", "scipy")
CODE_SUFFIXES = (".py", ".toml", ".fmu", ".npz", ".c", ".h", ".in")
ASIDE = {"cli", "figures", "recording", "results", "__pycache__", "report.py", "figures.py"}
"""Files and folders that bear on no number; `results` is in a wheel only."""

_data: dict[str, str] = {}
"""Hashes of data files as this process has seen them last, by path."""


def depends_on(
    scenario: Scenario,
    *parts: Any,
    files: Mapping[str, str | Path] | None = None,
) -> dict[str, str]:
    """All that a result depends on, by name: versions as text, everything else as hashes.

    Plug-ins are taken as this process has loaded them, see `cosim.core.modules.code_of`.

    Args:
        scenario: the scenario; its FMU and its models count, too.
        parts: controllers and algorithms: a registered name, `module:Name`, a class or a factory.
        files: data files by their names in the answer.

    Returns:
        Words that are equal where the thing is; `cosim.core.modules.UNKNOWN` where that cannot
            be known.

    Raises:
        ControllerLookupError: a part cannot be imported.
        PlantError: the FMU cannot be read.
    """
    files = files or {}
    data = {}
    for name, path in files.items():
        present = file_hash(path) or "no file"
        seen_last = _data.get(str(path), present)
        if seen_last != present:
            # They may have read it while they were imported.
            forget_users_modules()
        _data[str(path)] = present
        data[name] = present
    # After the files: the code is that of modules as they are loaded from now on.
    facts = {
        "versions": versions(),
        "rti-cosim": code_hash(),
        "scenario": scenario.hash,
        "fmu": unpack(scenario.plant.fmu).sha256,
    }
    for part in (scenario.controller.model, scenario.plant.model, *parts):
        for module in _modules_of(part):
            code = code_of(module)
            # None of our own modules and of Python's, which have facts of their own.
            if code is not None:
                facts[f"plug-in {module}"] = code
    return facts | data


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Names of what differs between two answers of `depends_on`.

    Args:
        before: an answer.
        now: a later one.
    """
    # What is in one of them alone differs, too.
    names = sorted({*before, *now})
    return [name for name in names if before.get(name) != now.get(name)]


def _modules_of(part: Any) -> list[str]:
    """Modules of users and others that hold a part, and the object that it names."""
    if part is None:
        return []
    # The code is that of the function, the other arguments are data.
    while isinstance(part, partial):
        part = part.func
    if not isinstance(part, str):
        # A callable object has no module of its own.
        home = getattr(part, "__module__", None) or type(part).__module__
        return [home]
    by_name = registered(ALGORITHMS) | registered(CONTROLLERS)
    target = by_name.get(part, part)
    # A file of θ is no code.
    if not TARGET.fullmatch(target):
        return []
    module, _, _ = target.partition(":")
    package, _, _ = module.partition(".")
    if package in OURS:
        return []
    plugin = load_plugin(target, f"'{part}'", ControllerLookupError)
    # A module may only import what another one defines.
    home = getattr(plugin, "__module__", None) or module
    return sorted({module, home})


def file_hash(path: str | Path) -> str:
    """SHA-256 of a file, empty where there is none."""
    try:
        content = Path(path).read_bytes()
    except OSError:
        return ""
    return hashlib.sha256(content).hexdigest()


@cache
def versions() -> str:
    """Versions of Python and of the distributions that results depend on, as one line."""
    words = [f"python {platform.python_version()}"]
    for name in DISTRIBUTIONS:
        with suppress(PackageNotFoundError):
            words.append(f"{name} {version(name)}")
    return "; ".join(words)


@cache
def code_hash() -> str:
    """First 16 hex digits of the SHA-256 of our code that results depend on, C and FMUs included.

    A wheel and a checkout of one commit have the same.
    """
    digest = hashlib.sha256()
    for package in OURS:
        folder = ROOT / package
        # Sorted: a file system gives the entries of a folder in any order.
        for path in sorted(folder.rglob("*")):
            relative = path.relative_to(ROOT)
            # What only draws, prints or records may change without a new result.
            if not ASIDE.isdisjoint(relative.parts):
                continue
            if path.suffix not in CODE_SUFFIXES or not path.is_file():
                continue
            # The name counts, too: a module is found by it.
            name = relative.as_posix()
            content = hashlib.sha256(path.read_bytes())
            digest.update(f"{name}\0".encode())
            digest.update(content.digest())
    return digest.hexdigest()[:16]
