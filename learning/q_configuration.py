"""Hyperparameters that the two Q-learning rules share."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from learning.configuration import (
    Configuration,
    ExplorationProbability,
    ExplorationShare,
    NonNegative,
)
from learning.schedule import Geometric

Gain = Annotated[
    float, Field(gt=0, le=1, description="share of the rule's step that is taken, at the start")
]
FinalGain = Annotated[
    float, Field(gt=0, le=1, description="the same at the end, approached geometrically")
]


class QConfiguration(Configuration):
    """Hyperparameters of a fit of Q to its TD errors, online or in batches."""

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

    def gains(self, samples: int) -> Geometric:
        """Schedule of the gain over a run of `samples` samples."""
        return Geometric(self.gain, self.gain_end, samples)
