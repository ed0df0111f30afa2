"""Controllers by name: registered ones, files of θ, and factories of users.

A factory takes a scenario and returns a controller for it; those here are the package's entry
points of the group `cosim.controllers`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from controllers.converged import ConvergedNmpc
from controllers.errors import ControllerError, ModelError, OptimumError, ParameterError
from controllers.problem import PlantProblem, Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.errors import ControllerLookupError
from cosim.core.files import read_text
from cosim.core.modules import (
    CONTROLLERS,
    OURS,
    exception_line,
    importing,
    load_plugin,
    registered,
)
from cosim.core.protocols import Controller
from cosim.core.scenario import Scenario, is_file
from cosim.core.validation import suggestion

if TYPE_CHECKING:
    from controllers.linear import Lqr, PiLoops
    from controllers.optimum import OptimalPolicy, QuasiStaticPolicy
    from controllers.periodic_optimum import PeriodicPolicy

# Imported where it is needed: who simulates an RTI-NMPC shall not pay for SciPy and Clarabel.


def nmpc(
    scenario: Scenario,
    parameters: Parameters,
    kind: str = "rti",
) -> RtiNmpc:
    """NMPC for a scenario with given θ; the RTI-NMPC solves as many QPs a sample as that says.

    Args:
        scenario: The scenario.
        parameters: θ.
        kind: `rti` or `converged`.

    Raises:
        ControllerError: Another `kind`.
        ParameterError: θ has an estimator's variances, and the scenario has no sensor.
    """
    if "noise" in parameters.blocks and not scenario.sensors:
        raise ParameterError(
            f"θ has a block noise, variances of an estimator, and scenario '{scenario.name}' has "
            "no sensor: take a scenario with the sensors of this θ"
        )
    if "margin" in parameters.blocks and (not scenario.sensors or kind != "rti"):
        raise ParameterError(
            "θ has a block margin, deviations of an estimate by which the RTI-NMPC tightens its "
            "bounds: take a scenario with [[sensor]] and the controller rti"
        )
    problem = Problem.from_scenario(scenario)
    settings = scenario.controller
    if kind == "converged":
        # Its Hessian is the exact one, and it iterates to convergence: it has no use for the rest.
        return ConvergedNmpc(problem, parameters, backend=settings.backend)
    if kind != "rti":
        raise ControllerError(f"there is no NMPC '{kind}'; there are rti and converged")
    return RtiNmpc(
        problem,
        parameters,
        hessian=settings.hessian,
        backend=settings.backend,
        iterations=settings.iterations,
    )


def value_offset(scenario: Scenario, problem: Problem) -> float:
    """c_λ at the start, as the scenario says: ℓ_s or ℓ_s/(1−γ).

    Args:
        scenario: The scenario.
        problem: Its problem.
    """
    if scenario.controller.value_offset == "discounted":
        return problem.value_level()
    return problem.reference_cost


def naive(scenario: Scenario, kind: str = "rti") -> RtiNmpc:
    """NMPC with the paper's naive guess, c_λ as the scenario says: baseline (a).

    Args:
        scenario: The scenario.
        kind: `rti` or `converged`.
    """
    problem = Problem.from_scenario(scenario)
    parameters = Parameters.naive(problem)
    offset = value_offset(scenario, problem)
    return nmpc(scenario, parameters.replace({"c_lambda": offset}), kind)


def from_toml(
    scenario: Scenario,
    text: str,
    path: str | Path,
    kind: str = "rti",
) -> RtiNmpc:
    """NMPC with θ from the text of a θ file.

    Args:
        scenario: The scenario.
        text: Text of the file.
        path: What the file is called in messages.
        kind: `rti` or `converged`.
    """
    problem = Problem.from_scenario(scenario)
    parameters = Parameters.from_toml(text, problem, path)
    return nmpc(scenario, parameters, kind)


def tuned(scenario: Scenario) -> RtiNmpc:
    """RTI-NMPC with the cost tuned by economics: baseline (b)."""
    from controllers.economic import tune  # noqa: PLC0415

    problem = Problem.from_scenario(scenario)
    parameters = tune(problem).parameters
    offset = value_offset(scenario, problem)
    return nmpc(scenario, parameters.replace({"c_lambda": offset}))


def lqr(scenario: Scenario) -> Lqr:
    """Linear state feedback with the tuned cost's weights."""
    from controllers.linear import Lqr  # noqa: PLC0415

    return Lqr(Problem.from_scenario(scenario))


def pi(scenario: Scenario) -> PiLoops:
    """A PI loop for each action, tuned by the SIMC rules."""
    from controllers.linear import PiLoops  # noqa: PLC0415

    return PiLoops(Problem.from_scenario(scenario))


def converged(scenario: Scenario) -> RtiNmpc:
    """NMPC solved to convergence with the paper's naive guess."""
    return naive(scenario, "converged")


def optimal(scenario: Scenario) -> OptimalPolicy | QuasiStaticPolicy | PeriodicPolicy:
    """Policy of least mean cost on the scenario's stochastic plant, solved once and then stored.

    Where the plant fouls or jumps, the quasi-static one; where prices move, that of each phase.
    """
    if scenario.signals:
        from controllers.periodic_optimum import PeriodicPolicy  # noqa: PLC0415

        return PeriodicPolicy.from_scenario(scenario)
    from controllers.optimum import OptimalPolicy, QuasiStaticPolicy, change_of  # noqa: PLC0415

    if change_of(scenario) is None:
        return OptimalPolicy.from_scenario(scenario)
    return QuasiStaticPolicy.from_scenario(scenario)


def stored_optimum(scenario: Scenario) -> str | None:
    """`optimal` where that is the plant's optimum and all of it is shipped or cached, else None.

    A foreign FMU may be another plant than the controller's model, whose optimum it is, unless the
    scenario names the plant's own model.
    """
    from controllers.dynamic_programming import Settings  # noqa: PLC0415
    from controllers.optimum import change_of, optimum_key, stored_file  # noqa: PLC0415
    from controllers.periodic_optimum import periodic_is_stored  # noqa: PLC0415

    # Nobody knows which plant a foreign FMU is.
    plant_is_known = scenario.plant.model is not None
    if is_file(scenario.plant.fmu) and not plant_is_known:
        return None
    if scenario.signals:
        return "optimal" if periodic_is_stored(scenario) else None
    change = change_of(scenario)
    # An optimum that is not stored would be solved for minutes: nobody has asked for that.
    plants = change.plants if change else [scenario]
    for plant in plants:
        try:
            problem = PlantProblem.from_scenario(plant)
        except (ModelError, OptimumError):
            return None
        # No controller is told what this policy needs.
        if problem.memory is not None:
            return None
        key = optimum_key(problem, Settings())
        if stored_file(key) is None:
            return None
    return "optimal"


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
            controller: Controller = from_toml(scenario, self.theta, name, self.kind)
            name = Path(name).stem
        elif name in known or ":" in name:
            controller = _made(name, known.get(name, name), scenario)
        else:
            raise ControllerLookupError(
                f"unknown controller '{name}'{suggestion(name, known)}; give one of "
                f"{', '.join(sorted(known))}, a parameters file (.toml), or module:factory"
            )
        if scenario.sensors:
            from controllers.estimator import measured  # noqa: PLC0415

            controller = measured(scenario, controller)
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
