"""The signals of a run as the recording draws them: unit, colour, bounds, range of view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import cycle
from math import inf, isfinite

import numpy as np
import rerun as rr

from cosim.protocols import Array, Block
from cosim.recording.palette import BOUND, SERIES
from cosim.scenario import Scenario

Range = tuple[float, float]
BUNDLES = ("disturbances", "step_time", "unseen")
"""Groups whose signals are one entity: each entity costs 40 bytes a sample beside its numbers."""


@dataclass(frozen=True)
class Channel:
    """One scalar signal; `bounds` may be infinite, `seen` is the range of its values so far.

    `step` says that a value holds until the next sample; `tail` is the share of the largest values
    that the range seen leaves out.
    """

    group: str
    name: str
    unit: str
    color: str
    bounds: Range = (-inf, inf)
    reference: float | None = None
    step: bool = False
    tail: float = 0.0
    seen: Range = (inf, -inf)

    @property
    def entity(self) -> str:
        """Path in the recording of the signal, or of the bundle that it is in."""
        return self.group if self.group in BUNDLES else f"{self.group}/{escaped(self.name)}"

    @property
    def bound_entity(self) -> str:
        """Path below which the lines of its bounds are."""
        return f"{self.entity}/bounds"

    @property
    def label(self) -> str:
        """Name and unit, as axes print them."""
        return self.name if self.unit in ("", "1") else f"{self.name} [{self.unit}]"

    def with_values(self, values: Array) -> Channel:
        """Widen the range seen by values of any shape; NaN counts as no value."""
        values = values[np.isfinite(values)]
        if not values.size:
            return self
        low, high = self.seen
        top = float(np.quantile(values, 1.0 - self.tail) if self.tail else values.max())
        return replace(self, seen=(min(low, float(values.min())), max(high, top)))

    def window(self) -> Range:
        """Range of view: the values seen, and each bound not farther from them than their span.

        Before any value: the bounds if both are finite and no reference is known, else a tenth of
        their distance on each side of the reference.
        """
        lower, upper = self.bounds
        low, high = self.seen
        if low > high:
            low, high = self._expected()
        span = max(high - low, 1e-3 * max(abs(low), abs(high))) or 1.0
        if low - span <= lower:
            low = min(low, lower)
        if upper <= high + span:
            high = max(high, upper)
        margin = 0.06 * max(high - low, span)
        return low - margin, high + margin

    def _expected(self) -> Range:
        lower, upper = self.bounds
        width = upper - lower
        if self.reference is None:
            return (lower, upper) if isfinite(width) else (0.0, 1.0)
        half = 0.1 * width if isfinite(width) else max(0.1 * abs(self.reference), 1e-3)
        return self.reference - half, self.reference + half


def escaped(name: str) -> str:
    """A variable's name, e.g. `tank[1].level`, as one part of an entity path."""
    return rr.escape_entity_path_part(name)


def run_channels(scenario: Scenario, units: Mapping[str, str]) -> list[Channel]:
    """Every signal of a run in the order of `run_columns`; a unit not known is left empty."""
    plant, told = scenario.plant, scenario.controller
    bounds = scenario.bounds
    cost = units.get(plant.stage_cost, "")
    state_rows = zip(
        plant.states, bounds.state_lower, bounds.state_upper, told.reference_state, strict=True
    )
    action_rows = zip(
        plant.actions, bounds.action_lower, bounds.action_upper, told.reference_action, strict=True
    )
    colors = cycle(SERIES)
    states = [
        Channel("states", name, units.get(name, ""), next(colors), (low, high), reference)
        for name, low, high, reference in state_rows
    ]
    actions = [
        Channel("actions", name, units.get(name, ""), next(colors), (low, high), reference, True)
        for name, low, high, reference in action_rows
    ]
    disturbances = [
        Channel("disturbances", name, units.get(name, ""), color, step=True)
        for name, color in zip(plant.disturbances, cycle(SERIES))
    ]
    return [
        *states,
        *actions,
        *disturbances,
        Channel("costs", "stage_cost", cost, SERIES[0]),
        Channel("costs", "penalty", cost, SERIES[1]),
        Channel("step_time", "prepare_time", "s", SERIES[5], tail=0.05),
        Channel("step_time", "feedback_time", "s", SERIES[1], tail=0.05),
        Channel("unseen", "violation", "", BOUND),
        Channel("unseen", "value", cost, SERIES[2]),
        Channel("unseen", "residual", "", SERIES[3]),
        Channel("unseen", "explored", "", SERIES[3]),
        Channel("unseen", "failed", "", SERIES[1]),
        Channel("unseen", "time", "s", SERIES[5]),
    ]


def run_columns(block: Block, violation: Callable[[Array], Array]) -> list[Array]:
    """Values of a block, (K,) for each channel of `run_channels`.

    `violation` maps states (K, n) to the violation of each bound, (K, n).
    """
    return [
        *block.states.T,
        *block.actions.T,
        *block.disturbances.T,
        block.stage_cost,
        block.penalty,
        block.prepare_time,
        block.feedback_time,
        violation(block.states).sum(axis=1),
        block.value,
        block.residual,
        block.explored.astype(np.float64),
        block.failed.astype(np.float64),
        block.time,
    ]
