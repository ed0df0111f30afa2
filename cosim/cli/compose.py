"""Builds plants and controllers from what a user names on the command line."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from cosim.errors import ControllerLookupError

if TYPE_CHECKING:
    from cosim.plant import FmuPlant
    from cosim.protocols import Controller
    from cosim.scenario import Scenario

GROUP = "cosim.controllers"


def build_plant(scenario: Scenario) -> FmuPlant:
    """Build the scenario's plant; raises PlantError."""
    from cosim.plant import FmuPlant

    return FmuPlant(scenario)


def build_controller(name: str, scenario: Scenario) -> Controller:
    """Build a controller for a scenario; raises ControllerLookupError and the controller's own.

    `name` is an entry point of the group `cosim.controllers`, a `module:factory` with
    factory(scenario) -> Controller, or the path of a θ file (TOML) for the RTI-NMPC.
    """
    known = _entry_points()
    if name in known:
        return _made(known[name].load(), name, scenario)
    if name.endswith(".toml"):
        return _from_parameters(Path(name), scenario)
    module, colon, factory = name.partition(":")
    if colon:
        return _made(_imported(name, module, factory), name, scenario)
    from cosim.validation import suggestion

    raise ControllerLookupError(
        f"unknown controller '{name}'{suggestion(name, known)}; give one of {', '.join(known)}, "
        "a parameters file (.toml), or module:factory"
    )


def _entry_points() -> dict[str, EntryPoint]:
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda p: p.name)}


def _imported(name: str, module: str, factory: str) -> Callable[..., Any]:
    try:
        return cast("Callable[..., Any]", getattr(importlib.import_module(module), factory))
    except (ImportError, AttributeError, ValueError) as error:
        raise ControllerLookupError(f"controller '{name}' cannot be imported: {error}") from None


def _made(factory: Callable[..., Any], name: str, scenario: Scenario) -> Controller:
    from cosim.protocols import Controller

    if not callable(factory):
        raise ControllerLookupError(f"controller '{name}' is not a factory: it cannot be called")
    controller = factory(scenario)
    if not isinstance(controller, Controller):
        raise ControllerLookupError(
            f"controller '{name}' made a {type(controller).__name__}, which lacks reset, prepare "
            "or feedback"
        )
    return controller


def _from_parameters(path: Path, scenario: Scenario) -> Controller:
    from controllers.factories import from_file

    return cast("Controller", from_file(cast("Any", scenario), path))
