"""Controllers by name: each function takes a scenario and returns a controller for it.

These are the package's entry points of the group `cosim.controllers`.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

from controllers.converged import ConvergedNmpc
from controllers.parameters import Parameters
from controllers.problem import Problem, ScenarioLike
from controllers.rti import IteratedNmpc, RtiNmpc

if TYPE_CHECKING:
    from controllers.dynamic_programming.plant import StochasticScenario
    from controllers.optimum import OptimalPolicy

# Imported where it is needed: who simulates an RTI-NMPC shall not pay for SciPy and Clarabel.


def rti(scenario: ScenarioLike, parameters: Parameters) -> RtiNmpc:
    """RTI-NMPC for a scenario with given θ, of as many QPs a sample as the scenario says."""
    settings = scenario.controller
    make = partial(IteratedNmpc, iterations=settings.iterations)
    return (RtiNmpc if settings.iterations == 1 else make)(
        Problem.from_scenario(scenario),
        parameters,
        hessian=settings.hessian,
        backend=settings.backend,
    )


def value_offset(scenario: ScenarioLike, problem: Problem) -> float:
    """c_λ at the start, as the scenario says: ℓ_s or ℓ_s/(1−γ)."""
    if scenario.controller.value_offset == "discounted" and problem.discount < 1:
        return problem.reference_cost / (1 - problem.discount)
    return problem.reference_cost


def naive_parameters(scenario: ScenarioLike, problem: Problem) -> Parameters:
    """The paper's naive θ, with c_λ as the scenario says."""
    return Parameters.naive(problem, value_offset=value_offset(scenario, problem))


def naive(scenario: ScenarioLike) -> RtiNmpc:
    """RTI-NMPC with the paper's naive guess: baseline (a)."""
    return rti(scenario, naive_parameters(scenario, Problem.from_scenario(scenario)))


def from_file(scenario: ScenarioLike, path: str | Path) -> RtiNmpc:
    """RTI-NMPC with θ from a parameters file."""
    return rti(scenario, Parameters.load(path, Problem.from_scenario(scenario)))


def tuned(scenario: ScenarioLike) -> RtiNmpc:
    """RTI-NMPC with the cost tuned by economics: baseline (b)."""
    from controllers.economic import tune  # noqa: PLC0415

    problem = Problem.from_scenario(scenario)
    return rti(scenario, tune(problem, value_offset=value_offset(scenario, problem)).parameters)


def converged(scenario: ScenarioLike) -> ConvergedNmpc:
    """NMPC solved to convergence with the paper's naive guess."""
    problem = Problem.from_scenario(scenario)
    return ConvergedNmpc(
        problem, naive_parameters(scenario, problem), backend=scenario.controller.backend
    )


def optimal(scenario: ScenarioLike) -> OptimalPolicy:
    """Policy of least mean cost on the scenario's stochastic plant, solved once and then stored."""
    from controllers.optimum import OptimalPolicy  # noqa: PLC0415

    return OptimalPolicy.from_scenario(cast("StochasticScenario", scenario))
