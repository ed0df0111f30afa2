"""Hyperparameters that Q-learning has online and in batches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from learning.configuration import (
    Count,
    ExplorationProbability,
    ExplorationShare,
    NonNegative,
    Positive,
)
from learning.globalised_configuration import GlobalisedConfiguration
from learning.schedule import Geometric

Gain = Annotated[
    float, Field(gt=0, le=1, description="share of the rule's step that is taken, at the start")
]
FinalGain = Annotated[
    float, Field(gt=0, le=1, description="the same at the end, approached geometrically")
]


class QConfiguration(GlobalisedConfiguration):
    """Hyperparameters of a fit of Q to its TD errors, online or in batches, by several `rule`s."""

    OPTIONS: ClassVar[Mapping[tuple[str, ...], tuple[str, ...]]] = {}
    """Which hyperparameters belong to which rules alone."""

    exploration_probability: ExplorationProbability = 0.3
    exploration_share: ExplorationShare = 1 / 30
    discount: float | None = Field(
        None, gt=0, le=1, description="of the TD error: the scenario's if not given; 1 is mean cost"
    )
    gain: Gain = 0.3
    gain_end: FinalGain = 0.03
    ridge: NonNegative = Field(
        1e-2, description="Levenberg–Marquardt term relative to each entry's information"
    )

    prior_width: Positive = Field(
        0.3, description="kalman: how far θ may be from its start, as a share of the start's cost"
    )
    measure_offset: bool = Field(
        True,
        description="kalman: c_f becomes the mean of the first prediction errors; false: it "
        "starts as it is, for a start that has learnt its offset",
    )
    innovation_clip: Positive = Field(
        3.0, description="kalman: innovations are cut at this many standard deviations"
    )
    variance_memory: Positive = Field(
        2000.0, description="kalman: samples over which the innovations' variance is taken"
    )
    prediction_errors: Count = Field(
        1000, description="kalman: prediction errors over which the next penalty is expected"
    )

    def without_part(self) -> Mapping[str, str]:
        """What belongs to other rules than the chosen one."""
        rule = getattr(self, "rule", None)
        other = {
            name: f"the rule {rule}"
            for rules, names in self.OPTIONS.items()
            if rule not in rules
            for name in names
        }
        return {**super().without_part(), **other}

    def gains(self, samples: int) -> Geometric:
        """Schedule of the gain over a run of `samples` samples."""
        return Geometric(self.gain, self.gain_end, samples)
