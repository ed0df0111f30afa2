"""Controllers by name: each function takes a scenario and returns a controller for it.

These are the package's entry points of the group `cosim.controllers`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from controllers.converged import ConvergedNmpc
from controllers.errors import ControllerError, ParameterError
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.scenario import Scenario

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
