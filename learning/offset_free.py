"""Offset-free: the model's mean one-step prediction error becomes its offset c_f."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from controllers.parameters import Parameters
from learning.algorithm import Transition
from learning.configuration import Count
from learning.practitioner import Practitioner, PractitionerConfiguration
from learning.prediction_errors import OneStepModel

Vector = NDArray[np.float64]


class OffsetFreeConfiguration(PractitionerConfiguration):
    """Settings of the offset-free baseline."""

    update_every: Count = Field(10, description="samples between two steps of c_f")
    memory: Count = Field(
        1000, description="samples of the filter: a running mean over fewer, exponential beyond"
    )


class OffsetFree(Practitioner):
    """c_f ← mean of s₊ − f(s, a), the integrating disturbance model of offset-free MPC.

    With `back_off` the bounds are then backed off on the rest of the samples, c_f held.
    """

    Configuration = OffsetFreeConfiguration
    _configuration: OffsetFreeConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._model = OneStepModel(self._scenario)
        self._parameters = self._model.parameters(self._reported)
        self._offset = self._reported["c_f"]
        self._seen = 0

    def learn(self, transition: Transition) -> Parameters | None:
        """Filter the error of one prediction."""
        predicted = self._model.predict(transition.s, transition.a, self._parameters)[0]
        self._seen += 1
        weight = 1.0 / min(self._seen, self._configuration.memory)
        self._offset = self._offset + weight * (transition.next_s - predicted - self._offset)
        return None if self._seen % self._configuration.update_every else self.conclude()

    def conclude(self) -> Parameters:
        """θ with the offset as it is."""
        return self._reported.replace({"c_f": self._offset})

    def state(self) -> dict[str, NDArray[Any]]:
        """The filter too."""
        return super().state() | {"offset": np.append(self._offset, self._seen)}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        super().restore(state)
        self._offset, self._seen = state["offset"][:-1], int(state["offset"][-1])
