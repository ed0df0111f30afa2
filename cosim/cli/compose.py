"""Builds plants and controllers from what a user names on the command line."""

from __future__ import annotations

import importlib
import sys
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from cosim.errors import ControllerLookupError

if TYPE_CHECKING:
    from cosim.cli.output import Output
    from cosim.plant import FmuPlant
    from cosim.protocols import Controller
    from cosim.scenario import Scenario

GROUP = "cosim.controllers"


def build_plant(scenario: Scenario, output: Output | None = None) -> FmuPlant:
    """Build the scenario's plant, announced on `output` if it is foreign; raises PlantError."""
    from cosim.plant import FmuPlant

    import_from_here()
    if output is not None:
        announce(scenario, output)
    return FmuPlant(scenario)


def announce(scenario: Scenario, output: Output) -> None:
    """Say which native code is about to run, unless it is the package's own."""
    from cosim.plant.archive import SHIPPED, unpack

    if scenario.plant.fmu not in SHIPPED:
        fmu = unpack(scenario.plant.fmu)
        output.note(f"native code of {fmu.path}, sha256 {fmu.sha256}")


def build_controller(name: str, scenario: Scenario) -> Controller:
    """Build a controller for a scenario; raises ControllerLookupError and the controller's own.

    `name` is an entry point of the group `cosim.controllers`, the path of a θ file (TOML) for the
    RTI-NMPC, or a `module:factory` with factory(scenario) -> Controller, importable from the
    Python path or the working directory.
    """
    import_from_here()
    known = {point.name: point for point in entry_points(group=GROUP)}
    if name in known:
        return _made(name, known[name].value, scenario)
    if name.endswith(".toml"):
        from controllers.factories import from_file

        return _named(cast("Controller", from_file(cast("Any", scenario), name)), Path(name).stem)
    if ":" in name:
        return _made(name, name, scenario)
    from cosim.validation import suggestion

    raise ControllerLookupError(
        f"unknown controller '{name}'{suggestion(name, known)}; give one of "
        f"{', '.join(sorted(known))}, a parameters file (.toml), or module:factory"
    )


def has_stored_optimum(scenario: Scenario) -> bool:
    """Whether `optimal` is J* of the scenario's plant and can be had without solving anything.

    A foreign FMU may be another plant than the controller's model, whose optimum it is.
    """
    from controllers.optimum import OptimalPolicy
    from cosim.plant.archive import SHIPPED

    if scenario.plant.fmu not in SHIPPED:
        return False
    return OptimalPolicy.stored(cast("Any", scenario)) is not None


def import_from_here() -> None:
    """Let `module:factory` name a module of the working directory too, after all others."""
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.append(folder)


def _made(name: str, target: str, scenario: Scenario) -> Controller:
    from cosim.protocols import Controller

    module, _, attribute = target.partition(":")
    try:
        factory = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ControllerLookupError(f"controller '{name}' cannot be imported: {error}") from None
    try:
        controller = factory(scenario)
    except TypeError as error:
        raise ControllerLookupError(
            f"controller '{name}' is not a factory of one scenario: {error}"
        ) from error
    if not isinstance(controller, Controller):
        raise ControllerLookupError(
            f"controller '{name}' made a {type(controller).__name__}, which lacks reset, prepare "
            "or feedback"
        )
    return _named(controller, name)


def _named(controller: Controller, name: str) -> Controller:
    """Let tables and recordings call the controller what the user called it."""
    with suppress(AttributeError):
        setattr(controller, "name", name)  # noqa: B010 (an optional attribute of the protocol)
    return controller
