"""The steady state of a plant that is nearest to where it starts, found by stepping its FMU."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cosim.errors import PlantError
from cosim.plant.fmu_plant import FmuPlant

Array = NDArray[np.float64]
DIFFERENCE = 1e-5
"""Finite differences, as a share of a variable's scale."""
ITERATIONS = 40
TIGHT, LOOSE = 1e-10, 1e-6
"""Residuals, as shares of the scales: where Newton stops, and what it may end with."""
PATIENCE = 5000
"""Samples that a plant which starts where it likes is given to settle."""


def nearest_steady_state(
    plant: FmuPlant, state: Array, action: Array
) -> tuple[Array, Array, float]:
    """Steady state x = Φ(x, u) of the undisturbed plant near (state (n,), action (m,)).

    Returns x, u and the stage cost there. Both x and u move, as little as need be in their scales,
    within the actions' bounds: Newton with the least-norm step. A plant that starts where it
    likes is left to settle under the action. Raises PlantError where there is no steady state.
    """
    if not plant.scenario.plant.mapping.initial_state:
        return _settled(plant, action)
    lower, upper = plant.scenario.action_lower, plant.scenario.action_upper
    scale = _scale(np.concatenate([state, action]))
    n = len(state)
    z = np.concatenate([state, np.clip(action, lower, upper)])

    def residual(z: Array) -> Array:
        plant.reset(0, z[:n])
        return (plant.step(z[n:]).s - z[:n]) / scale[:n]

    r = residual(z)
    for _ in range(ITERATIONS):
        if np.max(np.abs(r)) < TIGHT:
            break
        columns = [
            (residual(z + d) - residual(z - d)) / (2 * DIFFERENCE)
            for d in np.diag(DIFFERENCE * scale)
        ]
        step = scale * np.linalg.lstsq(np.array(columns).T, -r, rcond=1e-9)[0]
        for share in 0.5 ** np.arange(12):
            trial = z + share * step
            trial[n:] = np.clip(trial[n:], lower, upper)
            if np.linalg.norm(after := residual(trial)) < np.linalg.norm(r):
                z, r = trial, after
                break
        else:
            break
    if np.max(np.abs(r)) > LOOSE:
        raise PlantError(
            f"FMU '{plant.fmu_path.name}' has no steady state near its start values (a sample "
            f"still moves a state by {np.max(np.abs(r)):.2g} of its scale); give other start "
            "values by --state and --action"
        )
    plant.reset(0, z[:n])
    return z[:n], z[n:], plant.step(z[n:]).stage_cost


def _settled(plant: FmuPlant, action: Array) -> tuple[Array, Array, float]:
    s = plant.reset(0)
    for _ in range(PATIENCE):
        step = plant.step(action)
        if np.max(np.abs(step.s - s) / _scale(s)) < TIGHT:
            return step.s, action, step.stage_cost
        s = step.s
    raise PlantError(
        f"FMU '{plant.fmu_path.name}' does not settle within {PATIENCE} samples under the start "
        "values of its inputs; give an action under which it does by --action"
    )


def _scale(values: Array) -> Array:
    return np.maximum(np.abs(values), 1e-2)
