"""Plug-ins: what is registered, where users' modules are searched, which code was loaded."""

from __future__ import annotations

import ast
import hashlib
import importlib
import re
import sys
import sysconfig
import threading
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import entry_points, packages_distributions, version
from pathlib import Path
from typing import Any

CONTROLLERS = "cosim.controllers"
"""Group of entry points factory(scenario)."""
ALGORITHMS = "cosim.algorithms"
"""Group of entry points of algorithms."""
TARGET = re.compile(r"\w[\w.]*:\w[\w.]*")
"""Form of an object's name, `module:Name`."""
OURS = ("fmus", "cosim", "controllers", "learning")
"""The packages of this distribution; any other is a user's."""
ROOT = Path(__file__).absolute().parents[2]
"""Folder that holds them."""
PYTHON = [Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")]
"""Folders of Python's own modules."""
INSTALLED = {"site-packages", "dist-packages"}
"""Names of folders that a package manager fills."""
UNKNOWN = "cannot be known"
"""The code of a module without a file, as of a notebook's cell or a script that runs."""

_folders: list[str] = []
_loaded: dict[Path, str] = {}
"""Hash of the sources at each place from which a user's module was loaded, as of that time."""
_import_lock = threading.RLock()


@cache
def registered(group: str) -> dict[str, str]:
    """Targets, `module:Name`, of a group's entry points by name, as this process found them."""
    return {point.name: point.value for point in entry_points(group=group)}


def import_from(folder: str | Path) -> None:
    """Let `module:Name` name a module of this folder too, in this process.

    Args:
        folder: the folder, relative to the working directory as it is now.
    """
    path = str(Path(folder).absolute())
    if path not in _folders:
        _folders.append(path)


def import_folders() -> tuple[str, ...]:
    """Folders in which users' modules are searched, the working directory last."""
    folders = dict.fromkeys([*_folders, str(Path.cwd())])
    return tuple(folder for folder in folders if Path(folder) != ROOT)


@contextmanager
def importing() -> Iterator[None]:
    """Let import statements find modules of `import_folders`, after all others.

    No bytecode is written meanwhile. Python compares sizes and whole seconds only: after a quick
    edit it would run the old code.
    """
    with _import_lock:
        written = sys.dont_write_bytecode
        sys.dont_write_bytecode = True
        added = [folder for folder in import_folders() if folder not in sys.path]
        # A folder of such a name would be found before an editable install. Python looks for
        # no package that is loaded, and nor does this: a stat of each folder costs more than it.
        for package in OURS:
            if package in sys.modules:
                continue
            for folder in added:
                path = Path(folder, package)
                if path.exists() or path.with_suffix(".py").exists():
                    importlib.import_module(package)
        sys.path.extend(added)
        # Python keeps lists of what its folders hold; a file may be new.
        importlib.invalidate_caches()
        try:
            yield
        finally:
            sys.dont_write_bytecode = written
            for folder in added:
                with suppress(ValueError):
                    sys.path.remove(folder)


def load_plugin(
    target: str,
    what: str,
    error: type[Exception],
) -> Any:
    """Import an object by its name; a module that was edited since it was loaded is loaded anew.

    Args:
        target: the object as `module:Name`; the module may lie in one of `import_folders`.
        what: what it is, for messages.
        error: class of the exception that is raised.

    Returns:
        The object.

    Raises:
        error: the text has another form, two different files have the module's name, the import
            fails, or the module has no such name.
    """
    if not TARGET.fullmatch(target):
        raise error(f"{what} must be given as module:Name, not '{target}'")
    module, _, attribute = target.partition(":")
    foreign = not _is_ours(module)
    try:
        with importing():
            if foreign:
                _forget_edited_modules()
            plugin: Any = importlib.import_module(module)
            if foreign:
                _remember_code(module)
    except ModuleNotFoundError as cause:
        # Of a module that it imports itself the file and the line are told.
        if cause.name is None or not f"{module}.".startswith(f"{cause.name}."):
            raise error(f"{what} cannot be imported: {exception_line(cause)}") from cause
        from cosim.core.validation import suggestion  # noqa: PLC0415 - pydantic

        names = [path.stem for folder in import_folders() for path in Path(folder).glob("*.py")]
        raise error(
            f"{what} cannot be imported: there is no module '{cause.name}' in {Path.cwd()}, nor "
            f"is one installed{suggestion(cause.name, names)}"
        ) from cause
    # A module may raise anything while it is imported, and one that is a script may even exit.
    except (Exception, SystemExit) as cause:
        raise error(f"{what} cannot be imported: {exception_line(cause)}") from cause
    if foreign:
        _refuse_two_of_one_name(module, what, error)
    return _attribute_of(plugin, attribute, what, error)


def _attribute_of(
    module: Any,
    attribute: str,
    what: str,
    error: type[Exception],
) -> Any:
    """What a module has under a dotted name; raises `error` with the name that is close."""
    found = module
    for part in attribute.split("."):
        try:
            found = getattr(found, part)
        except AttributeError as cause:
            from cosim.core.validation import suggestion  # noqa: PLC0415 - pydantic

            known = [name for name in dir(found) if not name.startswith("_")]
            raise error(
                f"{what} cannot be imported: module '{module.__name__}' has no attribute "
                f"'{attribute}'{suggestion(part, known)}"
            ) from cause
        # A module may compute its attributes, by code that raises anything.
        except (Exception, SystemExit) as cause:
            raise error(f"{what} cannot be imported: {exception_line(cause)}") from cause
    return found


def target_in_file(file: str) -> str:
    """Form `module:Class` of what a Python file has, to be typed in place of the file's name.

    Args:
        file: the name that was typed, `folder/mine.py` say.
    """
    path = Path(file)
    names = []
    with suppress(OSError, ValueError, SyntaxError):
        for statement in ast.parse(path.read_bytes()).body:
            if isinstance(statement, ast.ClassDef):
                names.append(statement.name)
    # Helpers stand before what uses them.
    name = names[-1] if names else "Class"
    return f"{path.stem}:{name}"


def _remember_code(module: str) -> None:
    """Hash a loaded module's sources now: they may be edited while this process runs."""
    place = _place(module)
    if place is not None and not _is_pythons(place):
        _hash_when_loaded(place)


def exception_line(cause: BaseException) -> str:
    """The exception, its file and its line, as one line of text."""
    text = str(cause)
    # Of a failed import the message says all.
    if not isinstance(cause, ImportError):
        text = f"{type(cause).__name__}: {text}"
    line = " ".join(text.split())
    # The last frame that is neither Python's import nor this file.
    frames = traceback.extract_tb(cause.__traceback__)
    for frame in reversed(frames):
        is_importlib = frame.filename.startswith("<frozen")
        if not is_importlib and Path(frame.filename) != Path(__file__):
            return f"{line} ({frame.filename}, line {frame.lineno})"
    return line


def users_place(cause: BaseException) -> str:
    """Where in a user's code an exception arose, `FILE:LINE, in FUNCTION`; empty where in none.

    A user's code is what plug-ins were loaded from, but for what is installed.
    """
    users_places = [place for place, _ in _users_places()]
    our_folders = [ROOT / name for name in OURS]
    frames = traceback.extract_tb(cause.__traceback__)
    # The last one: what it calls of others' code raises what the user's call led to.
    for frame in reversed(frames):
        path = Path(frame.filename).absolute()
        is_users = any(path.is_relative_to(place) for place in users_places)
        is_ours = any(path.is_relative_to(folder) for folder in our_folders)
        if is_users and not is_ours and not _is_installed(path):
            return f"{frame.filename}:{frame.lineno}, in {frame.name}"
    return ""


def _top(module: str) -> str:
    """The package of a module, or the module itself where it is in none."""
    top, _, _ = module.partition(".")
    return top


def _is_ours(module: str) -> bool:
    return _top(module) in OURS


def code_of(module: str) -> str | None:
    """The code of a loaded module in words that are equal where the code is.

    They hold the distribution with its version, if the module is installed, and a hash of Python
    files. These are the files of its package, or of its folder and the packages in it, as this
    process loaded them. Files elsewhere, and data, are not part of it.

    Args:
        module: full name of the module.

    Returns:
        The words; `UNKNOWN` of a module without a file; None of our own modules and of Python's.
    """
    top = _top(module)
    if _is_ours(module) or top in sys.builtin_module_names:
        return None
    place = _place(module)
    if place is None:
        return UNKNOWN
    if _is_pythons(place):
        return None
    code = _hash_when_loaded(place)
    words = []
    if _is_installed(place):
        for name in _distributions().get(top, []):
            words.append(f"{name} {version(name)}")
    return " ".join([*words, code])


@cache
def _distributions() -> dict[str, list[str]]:
    """Installed distributions by the modules that they hold."""
    distributions = {}
    for module, names in packages_distributions().items():
        # A distribution stands there twice where two entries of sys.path lead to it.
        distributions[module] = sorted(set(names))
    return distributions


def _place(module: str) -> Path | None:
    """Place of a loaded module's sources: a folder, or an installed package or file.

    None of a module without a file, and of the script that runs, which was read at its start.
    """
    file = getattr(sys.modules.get(module), "__file__", None)
    if module == "__main__" or not isinstance(file, str):
        return None
    path = Path(file).absolute()
    if not path.is_file():
        return None
    # How many folders of packages the file is in.
    depth = module.count(".")
    if path.stem == "__init__":
        depth += 1
    folder = path.parents[depth]
    if folder.name not in INSTALLED:
        return folder
    # Of an installed one the package alone: its folder holds all that is installed.
    if depth == 0:
        return path
    return path.parents[depth - 1]


def _is_installed(place: Path) -> bool:
    return bool(INSTALLED & set(place.parts))


def _is_pythons(place: Path) -> bool:
    """Whether a place is a folder of Python's own modules."""
    in_python = any(place.is_relative_to(folder) for folder in PYTHON)
    return in_python and not _is_installed(place)


def _hash_when_loaded(place: Path) -> str:
    """Hash of the sources at a place, as of the time when its modules were first loaded."""
    # Reading them takes some 50 ms of a folder with 500 modules: not again for each question.
    if place not in _loaded:
        _loaded[place] = _sources_hash(place)
    return _loaded[place]


def _forget_edited_modules() -> None:
    """Remove the modules of places whose sources have changed since, so that they load anew."""
    for place, code in _users_places():
        if _sources_hash(place) != code:
            _forget(place)


def forget_users_modules() -> None:
    """Remove all modules of users, so that they load anew and read their data files again."""
    for place, _ in _users_places():
        _forget(place)


def _users_places() -> list[tuple[Path, str]]:
    """Places that a user edits, with their hashes; what is installed stays as it was loaded."""
    return [(place, code) for place, code in _loaded.items() if not _is_installed(place)]


def _forget(place: Path) -> None:
    del _loaded[place]
    # A list: the modules are removed meanwhile.
    for name in list(sys.modules):
        if not _is_ours(name) and _place(name) == place:
            del sys.modules[name]


def _refuse_two_of_one_name(
    module: str,
    what: str,
    error: type[Exception],
) -> None:
    """Raise `error` where another file in `import_folders` has a loaded module's name."""
    place = _place(module)
    if place is None:
        return
    top = _top(module)
    for name in import_folders():
        folder = Path(name)
        file = folder / f"{top}.py"
        package = folder / top / "__init__.py"
        if not file.is_file() and not package.is_file():
            continue
        # A copy of the same sources does no harm.
        if folder.samefile(place) or _sources_hash(folder) == _sources_hash(place):
            continue
        raise error(
            f"{what}: two files have the name of its module, '{place / top}' and '{folder / top}'; "
            "rename one of them, or use each in a process of its own"
        )


def _sources_hash(place: Path) -> str:
    """First 16 hex digits of the SHA-256 of a place's Python files, with their names."""
    digest = hashlib.sha256()
    files: Iterable[Path] = [place]
    if not place.is_file():
        files = _python_files(place, set())
    for path in files:
        # A file that cannot be read cannot be imported either.
        with suppress(OSError):
            content = hashlib.sha256(path.read_bytes())
            name = path.relative_to(place).as_posix()
            # Names of Linux may be no UTF-8; the null byte ends a name as nothing in it can.
            digest.update(f"{name}\0".encode(errors="surrogateescape"))
            digest.update(content.digest())
    return digest.hexdigest()[:16]


def _python_files(folder: Path, seen: set[Path]) -> Iterator[Path]:
    """Modules of a folder, compiled ones too, and those of the folders in it that hold any."""
    # Links may lead round in a circle.
    real = folder.resolve()
    if real in seen:
        return
    seen.add(real)
    with suppress(OSError):
        # Folders give their entries in any order.
        entries = sorted(folder.iterdir())
        suffixes = (".py", *EXTENSION_SUFFIXES)
        modules = [path for path in entries if path.name.endswith(suffixes)]
        # The first folder may hold packages alone.
        if not modules and len(seen) > 1:
            return
        for path in modules:
            if path.is_file():
                yield path
        for path in entries:
            is_ours = folder == ROOT and path.name in OURS
            is_package = path.name.isidentifier() and path.name != "__pycache__"
            if path.is_dir() and is_package and not is_ours:
                yield from _python_files(path, seen)
