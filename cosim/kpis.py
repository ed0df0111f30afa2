"""Key performance indicators of closed-loop runs."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np

from cosim.protocols import Array, Controller, Plant
from cosim.simulation import simulate
from cosim.trajectory import Trajectory


def indicators(run: Trajectory, burn_in: int = 0) -> dict[str, float]:
    """Indicators of a run after its first `burn_in` samples.

    Its `Trajectory.means`; `input_effort` (see there); `failures`, the number of samples under the
    fallback action.
    """
    lower, upper = run.scenario.action_lower, run.scenario.action_upper
    return run.means(burn_in) | {
        "input_effort": input_effort(run.actions[burn_in:], lower, upper),
        "failures": float(np.sum(run["failed"][burn_in:])),
    }


def measure(
    plant: Plant, controller: Controller, seed: int, steps: int, burn_in: int = 0
) -> tuple[dict[str, float], dict[str, float]]:
    """Indicators of `steps` samples after `burn_in` on a seed's noise, and what the clock said.

    The clock's figures are `wall_time_s` and quantiles of each phase of a sample in µs.
    """
    begin = perf_counter()
    run = simulate(plant, controller, burn_in + steps, seed, residuals=False)
    clock = {"wall_time_s": perf_counter() - begin}
    for name, quantiles in run.timing_summary().items():
        clock |= {f"{name}_{key}": value for key, value in quantiles.items()}
    return indicators(run, burn_in), clock


def indicators_of(
    plant: Plant, controller: Controller, seeds: Sequence[int], steps: int, burn_in: int = 0
) -> dict[str, Array]:
    """`indicators` of a controller on each of S seeds by name, (S,) each."""
    found = [measure(plant, controller, seed, steps, burn_in)[0] for seed in seeds]
    return {name: np.array([figures[name] for figures in found]) for name in found[0]}


def input_effort(actions: Array, lower: Array, upper: Array) -> float:
    """Mean over samples of Σᵢ |uᵢ,ₖ − uᵢ,ₖ₋₁| / (u_u − u_l)ᵢ, the share of the range moved.

    `actions` (K, m); `lower`, `upper` (m,). One sample moves nothing: 0.
    """
    if len(actions) < 2:
        return 0.0
    return float(np.mean(np.sum(np.abs(np.diff(actions, axis=0)) / (upper - lower), axis=1)))
