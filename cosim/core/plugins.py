"""Controllers by name: registered ones, files of θ, and factories of users."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Self

from cosim.core.errors import ControllerLookupError
from cosim.core.files import read_text
from cosim.core.modules import OURS, exception_line, importing, load_plugin
from cosim.core.protocols import Controller
from cosim.core.scenario import Scenario
from cosim.core.validation import suggestion

CONTROLLERS = "cosim.controllers"
"""Group of entry points factory(scenario)."""
ALGORITHMS = "cosim.algorithms"
"""Group of entry points of algorithms."""


@cache
def registered(group: str) -> dict[str, str]:
    """Targets, `module:Name`, of a group's entry points by name, as this process found them."""
    return {point.name: point.value for point in entry_points(group=group)}


@dataclass(frozen=True)
class ControllerSource:
    """A controller by its content, so that it is built alike whatever becomes of its file.

    Attributes:
        name: an entry point of the group `cosim.controllers`, a `module:factory`, or the path of a
            θ file.
        theta: text of the θ file.
        kind: the NMPC that carries θ, `rti` or `converged`.
    """

    name: str
    theta: str | None = None
    kind: str = "rti"

    @classmethod
    def read(cls, name: str) -> Self:
        """Read what `build_controller` takes; raises ControllerLookupError."""
        if not name.endswith(".toml") or name in registered(CONTROLLERS):
            return cls(name)
        return cls(name, read_text(name, f"parameters file '{name}'", ControllerLookupError))

    def build(self, scenario: Scenario) -> Controller:
        """Build the controller; raises ControllerLookupError and the controller's own errors."""
        known = registered(CONTROLLERS)
        name = self.name
        if self.theta is not None:
            # Import it by its name: `cosim` itself imports no controller here.
            read = load_plugin("controllers.factories:from_toml", "θ", ControllerLookupError)
            controller: Controller = read(scenario, self.theta, name, self.kind)
            name = Path(name).stem
        elif name in known or ":" in name:
            controller = _made(name, known.get(name, name), scenario)
        else:
            raise ControllerLookupError(
                f"unknown controller '{name}'{suggestion(name, known)}; give one of "
                f"{', '.join(sorted(known))}, a parameters file (.toml), or module:factory"
            )
        if scenario.sensors:
            # By its name, as above.
            wrap = load_plugin("controllers.estimator:measured", "estimator", ControllerLookupError)
            controller = wrap(scenario, controller)
        with suppress(AttributeError):  # as the user calls it, for tables and recordings
            setattr(controller, "name", name)  # noqa: B010 (an optional attribute of the protocol)
        return controller


def build_controller(name: str, scenario: Scenario) -> Controller:
    """Build a controller for a scenario.

    Args:
        name: an entry point of the group `cosim.controllers`; the path of a TOML file, θ of the
            RTI-NMPC; or a `module:factory` with factory(scenario) -> Controller.
        scenario: what it controls.

    Returns:
        The controller, with the attribute `name` where it can have one.

    Raises:
        ControllerLookupError: the name leads nowhere, or to no controller.
    """
    return ControllerSource.read(name).build(scenario)


def _made(
    name: str,
    target: str,
    scenario: Scenario,
) -> Controller:
    factory = load_plugin(target, f"controller '{name}'", ControllerLookupError)
    if not callable(factory):
        raise ControllerLookupError(f"controller '{name}' is not a factory of one scenario")
    # A factory may import modules beside its own only now.
    try:
        with importing():
            controller = factory(scenario)
    except (Exception, SystemExit) as error:
        packages = {base.__module__.partition(".")[0] for base in type(error).__mro__}
        # The words of our own errors say enough.
        if target == name and not packages & set(OURS):
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


def parameters_hash(controller: Any) -> str:
    """The hash of the controller's parameters, empty if it has none."""
    return str(getattr(getattr(controller, "parameters", None), "hash", "") or "")
