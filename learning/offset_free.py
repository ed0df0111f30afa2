"""Offset-free control: the mean prediction error becomes the offset of the model."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from controllers.theta import Parameters
from cosim.core.protocols import Vector
from learning.algorithm import Algorithm, Transition, Update
from learning.back_off import DEFAULT_BUDGET, backed_off_by_errors
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Configuration, Count, GreedyConfiguration
from learning.prediction_errors import OneStepModel, PredictionErrors
from learning.step import update_without_fit


class OffsetFreeConfiguration(GreedyConfiguration):
    """Hyperparameters of the offset-free baseline."""

    back_off: bool = Field(
        True,
        description="back the bounds off by the largest of the latest prediction errors",
    )
    update_every: Count = Field(10, description="samples between two steps of c_f")
    memory: Count = Field(
        1000,
        description="samples of the filter: a running mean over fewer, exponential beyond",
    )


class OffsetFree(Algorithm):
    """c_f ← mean of s₊ − f(s, a), the integrating disturbance model of offset-free MPC.

    With `back_off` the bounds are backed off by the largest of the last `memory` errors about that
    mean; while fewer are known, by the start's back-off where that is more.
    """

    Configuration: ClassVar[type[Configuration]] = OffsetFreeConfiguration
    configuration: OffsetFreeConfiguration
    budget: ClassVar[int] = DEFAULT_BUDGET
    explores = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._start = self.controller.parameters
        self._model = OneStepModel(self.scenario)
        # Of the start, for good: the offset is all that is learned of the model.
        self._parameters = self._model.parameters(self._start)
        self._errors = PredictionErrors(self.scenario, self.configuration.memory)
        self._offset: Vector = self._start["c_f"]

    def observe(self, transition: Transition) -> Update | None:
        """Filter the error of one prediction; every `update_every`-th moves θ."""
        s = transition.s
        a = transition.a
        (predicted,) = self._model.predict(s, a, self._parameters)
        error = transition.next_s - predicted
        self._errors.add(error)
        # A running mean until the memory is full, exponential from then on.
        weight = 1.0 / len(self._errors.values)
        innovation = error - self._offset
        self._offset = self._offset + weight * innovation
        if self._errors.count % self.configuration.update_every:
            return None
        old = self.controller.theta
        new = self._corrected()
        self.controller.theta = new.theta
        return update_without_fit(new.blocks, old, new.theta)

    def _corrected(self) -> Parameters:
        """θ with the offset and the back-off as they are."""
        present = self.controller.parameters
        present = present.replace({"c_f": self._offset})
        if not self.configuration.back_off:
            return present
        # Errors about the offset: it is in the predictions already.
        errors = self._errors.values - self._offset
        corrected = backed_off_by_errors(present, self.scenario, errors)
        if len(errors) == self.configuration.memory:
            return corrected
        # The largest of few errors is too small: the start's back-off counts too.
        start = self._start
        lower = np.maximum(corrected["x_l"], start["x_l"])
        upper = np.minimum(corrected["x_u"], start["x_u"])
        # Two back-offs that are each possible may leave no state between them.
        if (lower < upper).all():
            return corrected.replace({"x_l": lower, "x_u": upper})
        return corrected

    def state_dict(self) -> State:
        """The offset and the errors."""
        return {
            "offset": self._offset,
            **prefixed("errors", self._errors.state_dict()),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._offset = state["offset"]
        self._errors.load_state_dict(part_of(state, "errors"))
