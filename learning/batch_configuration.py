"""Hyperparameters of batch Q-learning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from learning.configuration import Count, Positive
from learning.q_configuration import FinalGain, Gain, QConfiguration


class BatchQLearningConfiguration(QConfiguration):
    """Hyperparameters of batch Q-learning."""

    OPTIONS: ClassVar[Mapping[tuple[str, ...], tuple[str, ...]]] = {
        ("kalman",): (
            "prior_width", "measure_offset", "innovation_clip", "variance_memory",
            "prediction_errors", "first_batch", "relinearisations",
        ),
        ("first-order", "gauss-newton", "lstdq"): (
            "gain", "gain_end", "ridge", "buffer_size", "iterations", "radius", "radius_minimum",
        ),
    }  # fmt: skip

    gain: Gain = 0.5
    gain_end: FinalGain = 0.05
    rule: Literal["kalman", "first-order", "gauss-newton", "lstdq"] = Field(
        "kalman",
        description="iterated Kalman filter with a prior on θ; normalised gradient; Gauss–Newton "
        "on Q's fit; or the projected Bellman error",
    )
    batch_size: Count = Field(500, description="samples between two updates")
    first_batch: Count | None = Field(
        None,
        description="kalman: samples of the first batch, which gives noise and widths; as the "
        "others if not given",
    )
    buffer_size: Count = Field(1000, description="transitions that are replayed, the latest ones")
    iterations: Count = Field(1, description="replays and steps of θ per update")
    relinearisations: Count = Field(2, description="kalman: replays and steps of θ per batch")
    radius: Positive = Field(
        1.0, description="trust region: largest scaled entry of a step, before definiteness"
    )
    radius_minimum: Positive = Field(
        0.01, description="size below which the trust region does not shrink"
    )
