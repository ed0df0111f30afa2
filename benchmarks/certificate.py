"""Adds a policy search's figure to the certificate of a scenario's optimum, in the user's cache.

    cosim optimum --scenario fouled --refine
    python -m benchmarks.certificate fouled search/parameters.toml

The best θ that a search found and the optimal policy run on the same noise of the FMU. The figure
is the certificate's simulation plus their paired difference.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from controllers import OptimalPolicy
from controllers import optimum as store
from controllers.dynamic_programming import SEARCH, GainEstimate, Settings, objection
from controllers.factories import build_controller
from controllers.problem import PlantProblem
from cosim.core.scenario import Scenario
from cosim.core.simulation import indicators_of
from cosim.core.statistics import mean
from cosim.plant import FmuPlant

SEEDS, STEPS = range(900_000, 900_010), 10_000


def main() -> None:
    """Compare, keep the certificate, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("parameters")
    chosen = parser.parse_args()
    scenario = Scenario.load(chosen.scenario)
    plant = PlantProblem.from_scenario(scenario)
    key = store.optimum_key(plant, Settings())
    path = store.stored_file(key)
    if path is None:
        parser.error("there is no stored optimum: run cosim optimum --refine first")
    found = store.read_optimum(path, key)
    with FmuPlant(scenario) as fmu:
        searched, best = (
            indicators_of(fmu, each, SEEDS, STEPS)["J"]
            for each in (
                build_controller(str(chosen.parameters), scenario),
                OptimalPolicy(plant, found),
            )
        )
    difference = mean(searched - best)
    base = next(figure for figure in found.certificate if figure.name == "simulation")
    value, (low, high) = base.value + difference.value, difference.interval
    half_width = 0.5 * float(np.hypot(high - low, base.upper - base.lower))
    figure = GainEstimate(SEARCH, value, value - half_width, value + half_width)
    others = [one for one in found.certificate if one.name != SEARCH]
    found = replace(found, certificate=(*others, figure))
    print(store.keep(key, found))
    for name, *numbers in found.certificate:
        print(f"{name:14s}", *(f"{number:10.2f}" for number in numbers))
    print(objection(found.certificate) or "no objection: it is called J*")


if __name__ == "__main__":
    main()
