"""Controllers by name: registered ones, files of parameters, and anyone's `module:factory`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from cosim.errors import ControllerLookupError
from cosim.plugins import OURS, blamed, load_plugin
from cosim.protocols import Controller
from cosim.scenario import Scenario
from cosim.validation import suggestion

GROUP = "cosim.controllers"
FILES = "cosim.controller_files"
PARAMETERS = EntryPoint("toml", "controllers.factories:from_file", FILES)
"""What a parameters file is read by, unless another package registers its own reader."""


def build_controller(name: str, scenario: Scenario) -> Controller:
    """Build a controller for a scenario; raises ControllerLookupError and the controller's own.

    `name` is an entry point of the group `cosim.controllers`; the path of a file, θ of the RTI-NMPC
    (TOML) or one whose suffix is an entry point, factory(scenario, path), of the group
    `cosim.controller_files`; or a `module:factory` with factory(scenario) -> Controller,
    importable from the Python path or the working directory.
    """
    import_from_here()
    known = {point.name: point for point in entry_points(group=GROUP)}
    if name in known:
        return _made(name, known[name].value, scenario)
    suffix = Path(name).suffix.removeprefix(".")
    files = {point.name: point for point in (PARAMETERS, *entry_points(group=FILES))}
    if suffix in files:
        read = load_plugin(files[suffix].value, f"the reader of .{suffix}", ControllerLookupError)
        controller: Controller = read(scenario, name)
        return _named(controller, Path(name).stem)
    if ":" in name:
        return _made(name, name, scenario)
    raise ControllerLookupError(
        f"unknown controller '{name}'{suggestion(name, known)}; give one of "
        f"{', '.join(sorted(known))}, a parameters file (.toml), or module:factory"
    )


def import_from_here() -> None:
    """Let `module:factory` name a module of the working directory too, after all others."""
    import_from(Path.cwd())


def import_from(folder: Path) -> None:
    """Let `module:factory` name a module of a folder too, after all others."""
    finder = _Folder(str(folder))
    if finder not in sys.meta_path:
        sys.meta_path.append(finder)


@dataclass(frozen=True)
class _Folder(MetaPathFinder):
    """Finds modules in a folder that nobody else finds.

    Not so an entry at the end of `sys.path`: a plain folder named as a package hides that package
    where it is installed as editable, since such a package is searched for last of all.
    """

    folder: str

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return None if path is not None else PathFinder.find_spec(fullname, [self.folder])


def _made(name: str, target: str, scenario: Scenario) -> Controller:
    factory = load_plugin(target, f"controller '{name}'", ControllerLookupError)
    if not callable(factory):
        raise ControllerLookupError(f"controller '{name}' is not a factory of one scenario")
    try:
        controller = factory(scenario)
    except TypeError as error:
        raise ControllerLookupError(
            f"controller '{name}' is not a factory of one scenario: {blamed(error)}"
        ) from error
    except Exception as error:
        if target == name and not _is_ours(error):
            raise ControllerLookupError(
                f"the factory of controller '{name}' failed: {blamed(error)}"
            ) from error
        raise
    if not isinstance(controller, Controller):
        raise ControllerLookupError(
            f"controller '{name}' made a {type(controller).__name__}, which lacks reset, prepare "
            "or feedback"
        )
    return _named(controller, name)


def _is_ours(error: Exception) -> bool:
    """Whether an error is one of this project, whose words say enough."""
    packages = {base.__module__.partition(".")[0] for base in type(error).__mro__}
    return bool(packages & set(OURS))


def _named(controller: Controller, name: str) -> Controller:
    """Let tables and recordings call the controller what the user called it."""
    with suppress(AttributeError):
        setattr(controller, "name", name)  # noqa: B010 (an optional attribute of the protocol)
    return controller
