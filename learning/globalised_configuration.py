"""Hyperparameters of a rule whose phases of learning are validated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from learning.configuration import Configuration, Count


class GlobalisedConfiguration(Configuration):
    """Hyperparameters of `GlobalisedLearning`."""

    globalisation: Literal["validated", "none"] | None = Field(
        None,
        description="validated: phases of learning and line searches, in which a θ must beat the "
        "incumbent on the same noise; none: the rule alone; if not given, as the rule recommends",
    )
    phase: Count = Field(2500, description="validated: samples of learning between validations")
    block: Count = Field(100, description="validated: samples of a block of a race")
    blocks: Count = Field(8, description="validated: blocks of a race that is not decided before")

    @property
    def globalised(self) -> bool:
        """Whether validation decides what is kept."""
        return self.globalisation != "none"

    def without_part(self) -> Mapping[str, str]:
        """What validation alone asks for, where there is none."""
        names = [] if self.globalised else ["phase", "block", "blocks"]
        return dict.fromkeys(names, "a rule that is not validated")

    def depends_on_samples(self) -> list[str]:
        """Validation shares the samples out, too."""
        shared = ["globalisation"] if self.globalised else []
        return [*super().depends_on_samples(), *shared]
