"""What bounds the actor-critic in operation: how often its step from one batch descends.

    python -m benchmarks.policy_gradient fouled cautious

θ rests. The derivative of J by θ is that of central differences on common noise. An estimate w of
the natural gradient descends where ∇Jᵀw > 0, which by chance alone half of them do. `signal` is the
mean of ∇Jᵀw over its standard deviation among batches. Development seed 7000.
"""

from __future__ import annotations

import argparse

import numpy as np

from controllers import compile_functions
from cosim.plant import FmuPlant
from cosim.scenario import Scenario
from cosim.simulation import simulate
from learning.actor_critic import ActorCritic
from learning.training_run import begin, make_run

SEEDS, STEPS, BURN, DIFFERENCE = range(700_000, 700_004), 5300, 300, 0.05
BATCHES = {1000: 100, 4000: 40, 16_000: 12}
DEVIATIONS = (1.0, 3.0)


class Estimates(ActorCritic):
    """Keeps each batch's estimate of the natural gradient, and lets θ rest."""

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self.found: list[np.ndarray] = []
        self.scale = self._step.scale

    def _update(self, number: int) -> None:
        gradient, fisher, _ = self.gradient()
        floor = self.configuration.ridge * np.trace(fisher) / gradient.size
        self.found.append(np.linalg.solve(fisher + floor * np.eye(gradient.size), gradient))


def derivative(plant, controller, scale) -> np.ndarray:
    """∇J in units of θ's scale, (n_θ,)."""
    theta, costs = controller.theta.copy(), []
    for i in range(theta.size):
        for sign in (1.0, -1.0):
            controller.theta = theta + sign * DIFFERENCE * scale[i] * np.eye(theta.size)[i]
            runs = (simulate(plant, controller, STEPS, k, residuals=False) for k in SEEDS)
            costs.append([(run["stage_cost"] + run["penalty"])[BURN:].mean() for run in runs])
    controller.theta = theta
    means = np.mean(costs, axis=1).reshape(-1, 2)
    return (means[:, 0] - means[:, 1]) / (2 * DIFFERENCE)


def main() -> None:
    """Print a line for each batch size and size of the exploration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("start")
    chosen = parser.parse_args()
    scenario = Scenario.load(chosen.scenario)
    true = None
    print(f"{chosen.scenario} from {chosen.start}")
    print("batch  exploration  batches  descend %  signal", flush=True)
    for factor in DEVIATIONS:
        for size, count in BATCHES.items():
            options = {"seed": 7000, "start": chosen.start}
            settings = {"batch_size": size}
            run = make_run("actor-critic", scenario, size * count, settings, **options)
            deviation = tuple(factor * run.configuration.deviation(scenario))
            settings = {"batch_size": size, "exploration_deviation": deviation}
            run = make_run("actor-critic", scenario, size * count, settings, **options)
            with FmuPlant(scenario) as plant:
                loop = begin(run, Estimates, plant)
                compile_functions(loop.controller, run.samples)
                for _ in range(run.samples):
                    loop.advance()
                if true is None:
                    true = derivative(plant, loop.controller, loop.algorithm.scale)
            along = np.array(loop.algorithm.found) @ true
            descend, signal = 100 * (along > 0).mean(), along.mean() / along.std(ddof=1)
            print(f"{size:5d} {factor:12.0f} {count:8d} {descend:10.0f} {signal:7.2f}", flush=True)


if __name__ == "__main__":
    main()
