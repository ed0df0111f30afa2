"""Back-off: the bounds that bind are moved inwards, by as much as pays on plant samples."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from learning.practitioner import Practitioner, PractitionerConfiguration


class BackOffConfiguration(PractitionerConfiguration):
    """Settings of the back-off search: none but where it starts."""

    back_off: Literal[True] = Field(True, description="search the back-off of the active bounds")
    estimation_share: Literal[0] = Field(0, description="nothing is estimated before the search")


class BackOff(Practitioner):
    """One number κ, found by a line search on the plant: the engineer's first remedy.

    From any start (`--start`), all else of θ stays; see `BackOffSearch`.
    """

    Configuration = BackOffConfiguration

    def estimation_samples(self) -> int:
        """None: the search begins at once."""
        return 0
