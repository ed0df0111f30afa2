"""Identified: model parameters fitted to plant data, then tuning and back-off with that model."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import least_squares

from controllers.economic import tune
from controllers.errors import TuningError
from controllers.model import Model
from controllers.parameters import Parameters
from learning.algorithm import Transition
from learning.configuration import Count
from learning.errors import DivergenceError
from learning.practitioner import Practitioner, PractitionerConfiguration
from learning.prediction_errors import OneStepModel

Vector = NDArray[np.float64]


class IdentifiedConfiguration(PractitionerConfiguration):
    """Settings of the identified baseline."""

    model_parameters: tuple[str, ...] = Field(
        (), description="parameters to fit; the model's uncertain ones if not given"
    )
    every: Count | None = Field(
        None,
        description="fit again after so many samples, to these; once, at the end of the estimate, "
        "if not given",
    )
    retune: bool = Field(True, description="tune the cost by economics with the fitted model")

    def learned_parameters(self, model: Model) -> tuple[str, ...]:
        """The parameters to fit."""
        return self.model_parameters or model.uncertain


class Identified(Practitioner):
    """p̂ = argmin Σ ‖(s₊ − f(s, a; p))/σ‖², the prediction-error method, carried in θ's block p.

    σ is the standard deviation of the errors at the start's parameters. Then the cost is tuned at
    the fitted model's optimal steady state and the bounds are backed off: what a practitioner does
    who knows which parameters of the plant have drifted. With `every` he does so again and again.
    """

    Configuration = IdentifiedConfiguration
    _configuration: IdentifiedConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._model = OneStepModel(self._scenario)
        self._rows: list[Vector] = []

    def learn(self, transition: Transition) -> Parameters | None:
        """Keep a transition; the last of every `every` gives a new fit."""
        self._rows.append(np.concatenate([transition.s, transition.a, transition.next_s]))
        if len(self._rows) != self._configuration.every:
            return None
        fitted = self.conclude()
        self._rows.clear()
        return fitted

    def conclude(self) -> Parameters:
        """θ with the fitted p and, unless told otherwise, the cost tuned with it.

        Raises DivergenceError where the fitted model has no economically optimal steady state.
        """
        start = self._reported
        if "p" not in start.blocks or not self._rows:
            return start
        fitted = start.replace({"p": self._fit()})
        if not self._configuration.retune:
            return fitted
        model = self._problem.model
        values = self._model.parameters(fitted)
        quantities = tuple(
            dataclasses.replace(quantity, nominal=float(value))
            for quantity, value in zip(model.parameters, values, strict=True)
        )
        identified = dataclasses.replace(model, parameters=quantities)
        problem = dataclasses.replace(self._problem, model=identified)
        try:
            tuned = tune(problem, start.blocks).parameters
        except TuningError as error:
            raise DivergenceError(f"the fitted model cannot be tuned ({error})") from error
        kept = ("c_lambda", "c_f", "x_l", "x_u", "w_sigma", "W_sigma")
        return tuned.replace({name: start[name] for name in kept if name in start.blocks})

    def _fit(self) -> Vector:
        """p̂, (n_p,), positive where its nominal value is."""
        n, start, rows = self._problem.n_states, self._reported, np.array(self._rows)
        states, actions, following = rows[:, :n], rows[:, n:-n], rows[:, -n:]
        indices = self._problem.model.parameter_indices(start.blocks.block("p").labels)
        values, nominal = self._model.parameters(start), self._problem.model.nominal_parameters
        unit = np.where(nominal[indices] != 0, np.abs(nominal[indices]), 1.0)
        sigma = self._model.errors(states, actions, following, start).std(axis=0)
        sigma = np.maximum(sigma, np.finfo(float).tiny)

        def residuals(scaled: Vector) -> Vector:
            values[indices] = scaled * unit
            predicted = self._model.predict(states, actions, values) + start["c_f"]
            errors: Vector = ((following - predicted) / sigma).reshape(-1)
            return errors

        found: Vector = least_squares(residuals, start["p"] / unit).x * unit
        return found

    def state(self) -> dict[str, NDArray[Any]]:
        """The transitions too."""
        return super().state() | {"rows": np.array(self._rows)}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        super().restore(state)
        self._rows = list(state["rows"])
