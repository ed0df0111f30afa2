"""The baseline of learning in operation: θ never changes."""

from __future__ import annotations

from typing import ClassVar

from learning.algorithm import Algorithm
from learning.configuration import Configuration, GreedyConfiguration


class Fixed(Algorithm):
    """θ stays at its start."""

    learns_from_estimates = True
    learns_under_signals = True

    Configuration: ClassVar[type[Configuration]] = GreedyConfiguration
    explores = False
