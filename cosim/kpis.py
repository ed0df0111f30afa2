"""Key performance indicators of one closed-loop run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cosim.scenario import Scenario
from cosim.trajectory import Trajectory

Array = NDArray[np.float64]

DISPLACEMENT = 0.1
BAND = 0.05
LAST = 0.25
ROUNDING = 1e-6
"""Share of a state's value below which a way is none: a state that starts where it ends."""


def indicators(run: Trajectory) -> dict[str, float]:
    """Indicators of a run, by name; each a mean per sample unless it says otherwise.

    `economic_cost` ℓ; `mean_violation` Σᵢ vᵢ; `violating_share` share of samples with
    Σᵢ vᵢ > `cosim.penalty.VIOLATING`, 1e-6 in the states' units, so that rounding at a bound does
    not count; `J` mean of ℓ + penalty, to which every violation counts; `input_effort` (see there);
    `failures` number of samples under the fallback action.
    """
    summary = run.summary()
    names = ("economic_cost", "mean_violation", "violating_share", "J")
    return {
        **{name: float(summary[name]) for name in names},
        "input_effort": input_effort(
            run.actions, run.scenario.action_lower, run.scenario.action_upper
        ),
        "failures": float(summary["failures"]),
    }


def input_effort(actions: Array, lower: Array, upper: Array) -> float:
    """Mean over samples of Σᵢ |uᵢ,ₖ − uᵢ,ₖ₋₁| / (u_u − u_l)ᵢ, the share of the range moved.

    `actions` (K, m); `lower`, `upper` (m,). One sample moves nothing: 0.
    """
    if len(actions) < 2:
        return 0.0
    return float(np.mean(np.sum(np.abs(np.diff(actions, axis=0)) / (upper - lower), axis=1)))


def comes_to_rest(scenario: Scenario) -> bool:
    """Whether the plant can settle at all: under permanent disturbances it never does."""
    return scenario.disturbance.law == "none"


def displaced(scenario: Scenario) -> Scenario | None:
    """The scenario without disturbances, started away from x_s; None where that is impossible.

    Every state starts `DISPLACEMENT` of its reference value above it, or below where the bounds
    leave no room above; a state whose reference is zero starts there.
    """
    reference = scenario.reference_state
    offset = DISPLACEMENT * np.abs(reference)
    start = np.where(
        reference + offset <= scenario.state_upper, reference + offset, reference - offset
    )
    if not np.any(offset) or not scenario.plant.mapping.initial_state:
        return None
    return scenario.replace(
        {"plant": {"initial_state": start.tolist()}, "disturbance": {"law": "none"}}
    )


def settling_time(run: Trajectory) -> float:
    """Time in s after which each state stays near its final value, within `BAND` of its way there.

    The final value is the mean of the last `LAST` of the run, which must be one without
    disturbances; NaN if a state still moves there by more than half its band: it has not settled.
    """
    states = run.states
    tail = max(1, round(LAST * len(states)))
    final = states[-tail:].mean(axis=0)
    distance = np.abs(states - final)
    band = np.maximum(BAND * distance[0], ROUNDING * np.abs(final))
    if np.any(np.ptp(states[-tail:], axis=0) > band / 2):
        return float("nan")
    outside = np.any(distance > band, axis=1)
    settled = int(np.flatnonzero(outside)[-1]) + 1 if np.any(outside) else 0
    return float(run.time[settled])
