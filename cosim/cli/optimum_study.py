"""Refines a scenario's optimal policy, and holds it against a θ of a policy search on the FMU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from controllers import factories
from controllers.dynamic_programming.certificate import SEARCH, Figure
from controllers.dynamic_programming.plant import PlantProblem
from controllers.dynamic_programming.settings import Settings
from controllers.dynamic_programming.solution import Optimum, Progress
from controllers.dynamic_programming.study import Row, certify, study
from controllers.optimum import OptimalPolicy
from cosim.plant import FmuPlant
from cosim.scenario import Scenario
from cosim.simulation import simulate
from cosim.statistics import mean

SEEDS, STEPS = range(900_000, 900_010), 10_000


def refined(
    plant: PlantProblem, settings: Settings, solved: Optimum, show: Callable[[Progress], None]
) -> tuple[list[Row], Optimum]:
    """The solution and what refines it, and the refinement that is kept with its certificate."""
    rows = study(plant, settings, solved, progress=show)
    return rows, certify(plant, rows)


def held_against(theta: Path, found: Optimum, plant: PlantProblem, scenario: Scenario) -> Optimum:
    """The optimum with a figure more in its certificate: J of the parameters file `theta`.

    It is the policy's simulated J and the difference to it, paired on the noise of `SEEDS`.
    """
    assert found.certificate is not None
    base = found.certificate["simulation"]
    assert base is not None
    policy = OptimalPolicy(plant, found)
    searched = factories.from_file(scenario, theta)
    with FmuPlant(scenario) as fmu:
        costs = [
            np.array(
                [simulate(fmu, each, STEPS, seed, residuals=False).summary()["J"] for seed in SEEDS]
            )
            for each in (searched, policy)
        ]
    difference = mean(costs[0] - costs[1])
    assert difference.t is not None
    value = base.value + difference.value
    spread = 0.5 * (difference.t[1] - difference.t[0])
    half_width = float(np.hypot(spread, 0.5 * (base.upper - base.lower)))
    figure = Figure(SEARCH, value, value - half_width, value + half_width)
    certificate = replace(found.certificate, figures=(*found.certificate.figures, figure))
    return replace(found, certificate=certificate)
