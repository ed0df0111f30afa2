"""Identification: the model's parameters by the prediction-error method, tuned with again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydantic import Field
from scipy.optimize import least_squares

from controllers.economic import tune
from controllers.errors import TuningError
from controllers.model import Model
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.protocols import Matrix, Vector
from learning.algorithm import Algorithm, Transition, Update
from learning.back_off import DEFAULT_BUDGET, backed_off_by_errors
from learning.checkpoint import State
from learning.configuration import Configuration, Count, GreedyConfiguration
from learning.errors import DivergenceError
from learning.prediction_errors import OneStepModel
from learning.step import update_without_fit


class IdentifiedConfiguration(GreedyConfiguration):
    """Hyperparameters of the identified baseline."""

    back_off: bool = Field(
        True,
        description="back the bounds off by the largest of the fitted model's errors",
    )
    model_parameters: tuple[str, ...] = Field(
        (),
        description="parameters to fit; the model's uncertain ones if not given",
    )
    every: Count | None = Field(
        None,
        description="samples between two fits, each to these; a shift's if not given",
    )

    def learned_parameters(self, model: Model) -> tuple[str, ...]:
        """The parameters to fit."""
        return super().learned_parameters(model) or model.uncertain


class Identified(Algorithm):
    """p̂ = argmin Σ ‖(s₊ − f(s, a; p))/σ‖², the prediction-error method, carried in θ's block p.

    σ is the standard deviation of the errors at the start's parameters. Then the cost is tuned at
    the fitted model's optimal steady state. The bounds are backed off by the largest of the
    fitted model's errors. This is done every shift.
    """

    Configuration: ClassVar[type[Configuration]] = IdentifiedConfiguration
    configuration: IdentifiedConfiguration
    budget: ClassVar[int] = DEFAULT_BUDGET
    explores = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._problem = Problem.from_scenario(self.scenario)
        self._model = OneStepModel(self.scenario)
        self._rows: list[list[float]] = []  # (s, a, s₊) since the last fit
        settings = self.configuration
        seconds = 3600.0 * settings.shift_hours
        shift = round(seconds / self.scenario.sampling_time)
        self._every = settings.every or max(shift, 1)

    def observe(self, transition: Transition) -> Update | None:
        """Keep a transition; the last of a shift gives a new fit."""
        row = [
            *transition.s.tolist(),
            *transition.a.tolist(),
            *transition.next_s.tolist(),
        ]
        self._rows.append(row)
        if len(self._rows) < self._every:
            return None
        old = self.controller.theta
        rows = np.array(self._rows)
        new = self._identified(rows)
        # A fit is of one shift: the plant of the next one may be another.
        self._rows.clear()
        self.controller.theta = new.theta
        return update_without_fit(new.blocks, old, new.theta)

    def _identified(self, rows: Matrix) -> Parameters:
        """θ with the fitted p, and the cost tuned with it.

        Args:
            rows: (s, a, s₊), (K, 2n+m).

        Raises:
            DivergenceError: the fitted model has no economically optimal steady state.
        """
        present = self.controller.parameters
        if "p" not in present.blocks:
            return present
        n = self._problem.n_states
        states = rows[:, :n]
        actions = rows[:, n:-n]
        next_states = rows[:, -n:]
        p = self._fit(present, states, actions, next_states)
        fitted = present.replace({"p": p})
        tuned = self._tuned(fitted)
        # The errors that are left are those of the fitted model.
        if not self.configuration.back_off:
            return tuned
        errors = self._model.errors(states, actions, next_states, tuned)
        return backed_off_by_errors(tuned, self.scenario, errors)

    def _fit(
        self,
        present: Parameters,
        states: Matrix,
        actions: Matrix,
        next_states: Matrix,
    ) -> Vector:
        """p̂, (n_p,), by nonlinear least squares from the present p."""
        model = self._problem.model
        labels = present.blocks.block("p").labels
        indices = model.parameter_indices(labels)
        nominal = model.nominal_parameters[indices]
        # Parameters in units of their values: one tolerance serves all.
        unit = np.where(nominal != 0, np.abs(nominal), 1.0)
        errors_before = self._model.errors(states, actions, next_states, present)
        # An exact model has no errors to weigh by.
        tiny = np.finfo(float).tiny
        sigma = np.maximum(errors_before.std(axis=0), tiny)
        values = self._model.parameters(present)
        offset = present["c_f"]

        def weighted_errors(scaled: Vector) -> Vector:
            # The model's other parameters stay as they are.
            values[indices] = scaled * unit
            predicted = self._model.predict(states, actions, values)
            predicted = predicted + offset
            errors = (next_states - predicted) / sigma
            return np.asarray(errors.reshape(-1))

        start = present["p"] / unit
        solution = least_squares(weighted_errors, start)
        return np.asarray(solution.x * unit)

    def _tuned(self, fitted: Parameters) -> Parameters:
        """θ with the cost tuned on the model with the fitted parameters."""
        model = self._problem.model
        # The tuning takes the fitted parameters for the model's nominal ones.
        quantities = []
        values = self._model.parameters(fitted)
        for quantity, value in zip(model.parameters, values, strict=True):
            quantities.append(replace(quantity, nominal=float(value)))
        identified = replace(model, parameters=tuple(quantities))
        problem = replace(self._problem, model=identified)
        try:
            tuned = tune(problem, fitted.blocks).parameters
        except TuningError as error:
            raise DivergenceError(f"the fitted model cannot be tuned ({error})") from error
        # The tuning is of the cost; offset and bounds stay.
        kept = {}
        for name in ("c_lambda", "c_f", "x_l", "x_u", "w_sigma", "W_sigma"):
            if name in fitted.blocks:
                kept[name] = fitted[name]
        return tuned.replace(kept)

    def state_dict(self) -> State:
        """The transitions since the last fit."""
        return {"rows": np.array(self._rows)}

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._rows = state["rows"].tolist()
