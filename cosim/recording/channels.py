"""The signals of a run as the recording draws them: unit, colour, bounds, range of view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import cycle
from math import inf, isfinite

import numpy as np
import rerun as rr

from cosim import signals
from cosim.protocols import Array, SampleBlock
from cosim.recording.palette import BOUND, SERIES
from cosim.scenario import Scenario
from cosim.signals import SignalKind

Range = tuple[float, float]
BUNDLES = ("disturbances", "step_time", "unseen")
"""Groups whose signals are one entity: each entity costs 40 bytes a sample beside its numbers."""
HELD = ("actions", "disturbances")
"""Signals that hold until the next sample."""
COLORS = {
    "penalty": SERIES[1],
    "prepare_time": SERIES[5],
    "feedback_time": SERIES[1],
    "violation": BOUND,
    "value": SERIES[2],
    "residual": SERIES[3],
}
"""Colour of a scalar signal, else the first of the series."""


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

    @property
    def title(self) -> str:
        """Label and bounds in words: the viewer's lines have no names, its font no sign for >=."""
        sides = zip(("at least", "at most"), self.bounds, strict=True)
        said = [f"{side} {bound:g}" for side, bound in sides if isfinite(bound)]
        return ", ".join([self.label, *said])

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
    bounds, told = scenario.bounds, scenario.controller
    known = {
        "states": (bounds.state_lower, bounds.state_upper, told.reference_state),
        "actions": (bounds.action_lower, bounds.action_upper, told.reference_action),
    }
    measured = cycle(SERIES)
    channels = []
    for kind in _recorded():
        colors = measured if kind.name in known else cycle(SERIES)
        for i, (name, unit) in enumerate(
            zip(kind.names(scenario), kind.units(scenario, units), strict=True)
        ):
            low, high, reference = (
                (values[i] for values in known[kind.name])
                if kind.name in known
                else (-inf, inf, None)
            )
            color = next(colors)
            channels.append(
                Channel(
                    group=str(kind.group),
                    name=name,
                    unit=unit,
                    color=COLORS.get(name, color),
                    bounds=(low, high),
                    reference=reference,
                    step=kind.name in HELD,
                    tail=0.05 if kind.clock else 0.0,
                )
            )
    return channels


def run_columns(block: SampleBlock) -> list[Array]:
    """Values of a block, (K,) for each channel of `run_channels`."""
    return [column for kind in _recorded() for column in block[kind.name].reshape(len(block), -1).T]


def _recorded() -> list[SignalKind]:
    return [kind for kind in signals.SIGNALS if kind.group is not None]
