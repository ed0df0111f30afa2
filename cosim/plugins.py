"""Controllers and other plug-ins by name, and the hashes of everything that a result depends on."""

from __future__ import annotations

import ast
import hashlib
import importlib
import os
import platform
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.util import resolve_name
from itertools import accumulate
from pathlib import Path
from types import ModuleType
from typing import Any

from cosim.errors import ControllerLookupError
from cosim.processes import watch
from cosim.protocols import Controller
from cosim.scenario import Scenario
from cosim.validation import suggestion

CONTROLLERS, ALGORITHMS = "cosim.controllers", "cosim.algorithms"
"""Groups of entry points: factory(scenario), and algorithms."""
TARGET = re.compile(r"\w[\w.]*:\w[\w.]*")
OURS = ("fmus", "cosim", "controllers", "learning")
"""The packages of this distribution; any other is a user's."""
ROOT = Path(__file__).absolute().parents[1]
"""Folder that holds them."""
KNOWN = (
    *(ROOT / package for package in OURS),
    *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")),
)
"""Folders of modules that are no user's, beside what is installed."""

_folders: list[str] = []


@cache
def registered(group: str) -> dict[str, str]:
    """Targets, `module:Name`, of a group's entry points by name, as this process found them."""
    return {point.name: point.value for point in entry_points(group=group)}


def import_from(folder: str | Path) -> None:
    """Let `module:Name` name a module of this folder too, in this process."""
    if (text := str(Path(folder).absolute())) not in _folders:
        _folders.append(text)


@contextmanager
def _importing(module: str) -> Iterator[None]:
    """Search the folders of `import_from` and the working directory last.

    Modules imported meanwhile are noted as brought by `module`.
    """
    before = set(sys.modules)
    here = [folder for folder in (*_folders, str(Path.cwd())) if Path(folder) != ROOT]
    added = [folder for folder in here if folder not in sys.path]
    for package in OURS:  # a folder of such a name would be found before an editable install
        names = [Path(folder) / f"{package}{end}" for folder in added for end in ("", ".py")]
        if any(name.exists() for name in names):
            importlib.import_module(package)
    sys.path.extend(added)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        for folder in added:
            with suppress(ValueError):
                sys.path.remove(folder)
        _brought.setdefault(module, set()).update(set(sys.modules) - before)
        _hash_foreign_modules()


def load_plugin(target: str, what: str, error: type[Exception]) -> Any:
    """Import the object `module:Name`; `what` names it in messages.

    Modules are searched in the working directory too, and in the folders of `import_from`. Raises
    `error` where the text has another form, the import fails, or the module has no such name.
    """
    if not TARGET.fullmatch(target):
        raise error(f"{what} must be given as module:Name, not '{target}'")
    module, _, attribute = target.partition(":")
    if module.partition(".")[0] not in OURS:
        watch(f"plug-in '{target}'")
    try:
        with _importing(module):
            found: Any = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    # A module may raise anything while it is imported, and one that is a script may even exit.
    except (Exception, SystemExit) as cause:
        raise error(f"{what} cannot be imported: {exception_line(cause)}") from cause
    return found


def exception_line(cause: BaseException) -> str:
    """The exception, its file and its line, as one line of text."""
    said = str(cause) if isinstance(cause, ImportError) else f"{type(cause).__name__}: {cause}"
    frames = [
        frame
        for frame in traceback.extract_tb(cause.__traceback__)
        if not frame.filename.startswith("<frozen") and Path(frame.filename) != Path(__file__)
    ]
    where = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{' '.join(said.split())}{where}"


def build_controller(name: str, scenario: Scenario) -> Controller:
    """Build a controller for a scenario; raises ControllerLookupError and the controller's own.

    `name` is an entry point of the group `cosim.controllers`; the path of a TOML file, θ of the
    RTI-NMPC; or a `module:factory` with factory(scenario) -> Controller.
    """
    known = registered(CONTROLLERS)
    if name.endswith(".toml") and name not in known:
        # Import it by its name: `cosim` itself imports no controller here.
        read = load_plugin("controllers.factories:from_file", "θ", ControllerLookupError)
        controller: Controller = read(scenario, name)
        name = Path(name).stem
    elif name in known or ":" in name:
        controller = _made(name, known.get(name, name), scenario)
    else:
        raise ControllerLookupError(
            f"unknown controller '{name}'{suggestion(name, known)}; give one of "
            f"{', '.join(sorted(known))}, a parameters file (.toml), or module:factory"
        )
    with suppress(AttributeError):  # as the user calls it, for tables and recordings
        setattr(controller, "name", name)  # noqa: B010 (an optional attribute of the protocol)
    return controller


def _made(name: str, target: str, scenario: Scenario) -> Controller:
    factory = load_plugin(target, f"controller '{name}'", ControllerLookupError)
    if not callable(factory):
        raise ControllerLookupError(f"controller '{name}' is not a factory of one scenario")
    try:
        with _importing(target.partition(":")[0]):
            controller = factory(scenario)
    except (Exception, SystemExit) as error:
        packages = {base.__module__.partition(".")[0] for base in type(error).__mro__}
        if target == name and not packages & set(OURS):  # the words of ours say enough
            raise ControllerLookupError(
                f"the factory of controller '{name}' failed: {exception_line(error)}"
            ) from error
        raise
    if not isinstance(controller, Controller):
        raise ControllerLookupError(
            f"controller '{name}' made a {type(controller).__name__}, which lacks reset, prepare "
            "or feedback"
        )
    return controller


# What a result depends on

DISTRIBUTIONS = ("rti-cosim", "casadi", "daqp", "fmpy", "numpy", "proxsuite", "scipy")
SUFFIXES = (".py", ".toml", ".fmu", ".npz")
# These files do not affect any stored number.
ASIDE = {"cli", "figures", "recording", "__pycache__", "report.py", "figures.py"}

_brought: dict[str, set[str]] = {}
"""Modules that loading a plug-in, and calling its factory, imported, by the plug-in's module."""
_sources: dict[str, tuple[Any, str]] = {}
"""Users' modules with the hash of their source as it was when they were loaded."""
_looked_at: dict[str, object] = {}
"""Modules by name whose source has been looked at."""


def depends_on(scenario: Scenario, *parts: Any) -> dict[str, str]:
    """Hashes by name (16 hex digits each, versions as text) of all that a result depends on.

    Hashed are versions, our own code, the scenario, its FMU and models, and the files of `parts`
    (controllers, algorithms: a registered name, a `module:Name`, a file's path, a class or
    factory): a parameters file, or the module and all that it imports from outside installed
    packages, as loaded, or as it is now if a function will import it later. Data files that a
    plug-in reads are not detected. Raises the errors of `load_plugin` as ControllerLookupError.
    """
    found = {"versions": versions(), "rti-cosim": code_hash(), "scenario": scenario.hash}
    fmu = Path(scenario.plant.fmu)
    if fmu.is_file():
        found[fmu.name] = _digest(fmu.read_bytes())
    for part in (scenario.controller.model, scenario.plant.model, *parts):
        if part is not None:
            found |= sources_of(part)
    return dict(sorted(found.items()))


def changed(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names whose hashes differ between two answers of `depends_on`."""
    return sorted(name for name in {*before, *now} if before.get(name) != now.get(name))


def sources_of(part: Any) -> dict[str, str]:
    """Hashes by name of the users' files behind one part; see `depends_on`."""
    if isinstance(part, partial):
        found = sources_of(part.func)
        for argument in (*part.args, *part.keywords.values()):
            if isinstance(argument, str | Path) or callable(argument):
                found |= sources_of(argument)
        return found
    if not isinstance(part, str | Path):
        _hash_foreign_modules()
        return _closure(getattr(part, "__module__", None) or type(part).__module__)
    known = registered(ALGORITHMS) | registered(CONTROLLERS)
    if part in known:
        return sources_of(known[str(part)])
    if TARGET.fullmatch(str(part)):
        module = str(part).partition(":")[0]
        if module.partition(".")[0] in OURS:
            return {}
        load_plugin(str(part), f"'{part}'", ControllerLookupError)
        return _closure(module)
    path = Path(part)
    return {path.name: _digest(path.read_bytes())} if path.is_file() else {}


def _closure(module: str) -> dict[str, str]:
    """Hashes of a user's module and of those that it reaches by import statements or brought."""
    found: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        waiting += [name.rpartition(".")[0]] if "." in name else []
        if name not in sys.modules:
            _hash_later_module(name)
        if name not in _sources or _file_name(name) in found:
            continue
        found[_file_name(name)] = _sources[name][1]
        waiting += [*_imports(name), *_brought.get(name, ())]
    return found


def _hash_later_module(name: str) -> None:
    """Note the present source of a user's module that a function will import later."""
    _sources.pop(name, None)
    path: list[str] | None = None
    for part in accumulate(name.split("."), "{}.{}".format):
        spec = PathFinder.find_spec(part, path)
        if spec is None or (spec.submodule_search_locations is None and part != name):
            return
        path = list(spec.submodule_search_locations or ())
    if spec and spec.origin and _is_foreign(str(Path(spec.origin).parent)):
        module = ModuleType(name)
        module.__file__, module.__package__ = spec.origin, spec.parent
        _sources[name] = (module, _digest(Path(spec.origin).read_bytes()))


def _file_name(module: str) -> str:
    path = Path(str(_sources[module][0].__file__))
    parts = len(module.split(".")) + (path.name == "__init__.py")
    return "/".join(path.parts[-parts:])


def _imports(module: str) -> list[str]:
    """Names that the import statements of a user's module may mean as modules."""
    loaded = _sources[module][0]
    try:
        tree = ast.parse(Path(str(loaded.__file__)).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return []
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                with suppress(ImportError):
                    base = resolve_name("." * node.level + base, loaded.__package__)
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return names


def _hash_foreign_modules() -> None:
    """Note the source of users' modules that have been loaded."""
    for name, module in list(sys.modules.items()):
        if _looked_at.get(name) is module:
            continue
        _looked_at[name] = module
        file = getattr(module, "__file__", None)
        if isinstance(file, str) and _is_foreign(file.rpartition(os.sep)[0]):
            with suppress(OSError):
                _sources[name] = (module, _digest(Path(file).read_bytes()))


@cache
def _is_foreign(folder: str) -> bool:
    """Whether modules of a folder are a user's: neither ours, installed, nor Python's own."""
    path = Path(folder).absolute()
    if {"site-packages", "dist-packages"} & set(path.parts):
        return False
    return not any(path.is_relative_to(place) for place in KNOWN)


@cache
def versions() -> str:
    """Versions of Python and of the distributions that results depend on, as one line."""
    found = [f"python {platform.python_version()}"]
    for name in DISTRIBUTIONS:
        with suppress(PackageNotFoundError):
            found.append(f"{name} {version(name)}")
    return "; ".join(found)


@cache
def code_hash() -> str:
    """First 16 hex digits of the SHA-256 of the code that results depend on, FMUs included."""
    digest = hashlib.sha256()
    for package in OURS:
        for path in sorted((ROOT / package).rglob("*")):
            relative = path.relative_to(ROOT)
            if path.suffix in SUFFIXES and not ASIDE & set(relative.parts) and path.is_file():
                digest.update(f"{relative.as_posix()}\0".encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def parameters_hash(controller: Any) -> str:
    """The hash of the controller's parameters, empty if it has none."""
    return str(getattr(getattr(controller, "parameters", None), "hash", "") or "")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
