"""Moved to `learning.loop`; `TrainingLoop.start` takes the state to which the plant was reset."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.loop import TrainingLoop


class Interaction(TrainingLoop):
    """A `TrainingLoop` that resets its plant itself."""

    def __init__(self, plant: Any, *rest: Any) -> None:
        super().__init__(plant, *rest)
        self._own = plant

    def start(self, s: int | NDArray[np.float64]) -> None:
        """Reset the plant with a seed, or begin at a state."""
        super().start(self._own.reset(s) if isinstance(s, int) else s)

    def __getattr__(self, name: str) -> Any:
        """Counts."""
        if name == "counts":
            raise AttributeError(name)
        return getattr(self.counts, name)
