"""Settings of a training from logged data, beside the hyperparameters of its rule."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

from cosim.core.scenario import NonNegative, Positive
from cosim.core.validation import validated
from learning.configuration import Count, Share
from learning.errors import ConfigurationError

Stretches = Annotated[int, Field(ge=2, le=50)]
"""Number of stretches that a log is parted in."""


class LogConfiguration(BaseModel):
    """Limits for refusing a log or leaving out samples, and the level of its verdict."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    # what is refused
    largest_shift: Annotated[int, Field(ge=1, le=20)] = Field(
        2,
        description="rows by which the inputs may be logged early or late, to be looked for",
    )
    misreading_evidence: NonNegative = Field(
        10.0,
        description="nats by which the log must speak for another reading of itself to be refused",
    )
    misreading_share: NonNegative = Field(
        0.005,
        description="nats for each reading below which it does not speak for one, under sensors",
    )
    largest_error_ratio: Positive = Field(
        5.0,
        description='times that the nominal model may err as much as "nothing changes" does, '
        "before it is of another plant",
    )
    least_bias: NonNegative = Field(
        0.5,
        description="mean error that it must have for that, over h: as of disturbances half their "
        "magnitude off",
    )
    persistent_innovations: Share = Field(
        0.3,
        description="share of an error of prediction that the one before says, above which the "
        "model is called in doubt, under sensors",
    )
    # what is left out
    jump_size: Positive = Field(
        10.0,
        description="standard deviations, by the median, above which an error is a jump",
    )
    return_size: Positive = Field(
        4.0,
        description="standard deviations above which an error after a jump may be the one back",
    )
    largest_jump_ratio: Annotated[float, Field(ge=1, allow_inf_nan=False)] = Field(
        1.3,
        description="largest ratio of the jump there and the one back",
    )
    longest_dropout: Count = Field(10, description="most rows from a jump to the one back")
    # how a prediction is judged
    drawn_models: Annotated[int, Field(ge=2)] = Field(
        16,
        description="models that are drawn from the posterior",
    )
    stretches: Annotated[tuple[Stretches, ...], Field(min_length=1)] = Field(
        (16, 8),
        description="numbers of stretches of the log by whose spread the chance of disturbances "
        "is told; the one that says most counts",
    )
    least_shown: Share = Field(
        0.5,
        description="share of a direction's prior variance that the log must remove to show it",
    )

    @classmethod
    def of(cls, values: Mapping[str, Any] | Self | None) -> Self:
        """Settings from a mapping, or as they are.

        Args:
            values: by name; None for the defaults.

        Raises:
            ConfigurationError: names the field and what it may be.
        """
        if isinstance(values, cls):
            return values
        return validated(cls, dict(values or {}), "log settings", ConfigurationError)
