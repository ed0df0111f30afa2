"""The practitioner's methods, from plant data: back-off, offset, parameters of the model.

In operation (`BackOff`, `OffsetFree`, `Identified`) offset and parameters are estimated to the end
of the run. On a simulator (`…Simulator`) a `BackOffSearch` follows the estimate; the plant is reset
before each of its stretches, on the same noise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy.optimize import least_squares

from controllers.economic import tune
from controllers.errors import TuningError
from controllers.model import Model
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector
from cosim.scenario import Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.back_off_search import BackOffSearch
from learning.configuration import Configuration, Count
from learning.episodes import Episode, Planned, Told
from learning.errors import DivergenceError
from learning.prediction_errors import OneStepModel
from learning.step import moved

BackOffToo = Annotated[bool, Field(description="search the back-off of the active bounds")]
ESTIMATION = 0.25
"""Share of the samples for the estimate that comes before a search."""
SHIFT = 8 * 3600.0
"""Seconds between two identifications, unless told otherwise."""


class GreedyConfiguration(Configuration):
    """Hyperparameters of a rule with greedy samples and without a fit of θ."""

    exploration: Literal["none"] = Field(
        "none", description="none: it is θ that is tried, not actions"
    )

    def for_scenario(self, scenario: Scenario) -> Self:
        """Copy with what the scenario states of c_lambda's start; its exploration has no part."""
        own = {name: getattr(self, name) for name in type(self).model_fields if "explor" in name}
        return super().for_scenario(scenario).model_copy(update=own)

    def without_part(self) -> Mapping[str, str]:
        """Hyperparameters of exploration and steps."""
        explored = [name for name in type(self).model_fields if name.startswith("exploration_")]
        stepped = ["smallest_eigenvalue"]
        return dict.fromkeys([*explored, *stepped], "a rule that tries θ, not actions")


class OffsetFreeConfiguration(GreedyConfiguration):
    """Settings of the offset-free baseline."""

    back_off: BackOffToo = True
    update_every: Count = Field(10, description="samples between two steps of c_f")
    memory: Count = Field(
        1000, description="samples of the filter: a running mean over fewer, exponential beyond"
    )


class IdentifiedConfiguration(GreedyConfiguration):
    """Settings of the identified baseline."""

    back_off: BackOffToo = True
    model_parameters: tuple[str, ...] = Field(
        (), description="parameters to fit; the model's uncertain ones if not given"
    )
    every: Count | None = Field(
        None,
        description="fit again after so many samples, to these; in operation a shift of eight "
        "hours, on a simulator once, at the end of the estimate, if not given",
    )

    def learned_parameters(self, model: Model) -> tuple[str, ...]:
        """The parameters to fit."""
        return self.model_parameters or model.uncertain


class BackOff(Planned):
    """One number κ a bound that binds, found by a line search (`BackOffSearch`); else θ stays."""

    Configuration: ClassVar[type[Configuration]] = GreedyConfiguration
    budget: ClassVar[int] = 8000

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._search = BackOffSearch(
            self.controller.parameters, self.scenario, self.samples, self.rng
        )
        self.follow(self._search.plan())

    @property
    def theta(self) -> Vector:
        """θ with the best back-offs found so far, (n_θ,)."""
        return self._search.theta.theta


class BackOffSimulator(BackOff):
    """`BackOff` on a plant that is put back before each stretch."""

    asks_for = "simulator"


class Estimate(Planned):
    """An estimate from the samples: on a simulator before the search, in operation in its place.

    A subclass says how it `learn`s from a transition and how it `conclude`s. In operation it backs
    off by its own errors of prediction.
    """

    KEPT: ClassVar[tuple[str, ...]] = ("_found",)
    budget: ClassVar[int] = BackOff.budget

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._problem = Problem.from_scenario(self.scenario)
        self._start = self.controller.parameters
        self._found = self._start.theta
        self._search: BackOffSearch | None = None
        samples = self.samples if self.asks_for == "simulator" else self.samples + 1
        if self.asks_for == "simulator" and self.configuration.back_off:
            samples = max(round(ESTIMATION * self.samples), 1)
            left = self.samples - samples
            self._search = BackOffSearch(self._start, self.scenario, left, self.rng)
        self.follow(self._estimate_and_search(samples))

    def _estimate_and_search(self, samples: int) -> Iterator[Episode]:
        yield (estimation := Episode(self._found, samples))
        self._found = estimation.answer["theta"]
        if self._search is not None:
            self._search.start = self._reported
            yield from self._search.plan()

    def learn(self, transition: Transition) -> Parameters | None:
        """Take a sample of the estimation; the θ to go on with, or None."""
        raise NotImplementedError

    def conclude(self) -> Parameters:
        """θ at the end of the estimation."""
        raise NotImplementedError

    @property
    def theta(self) -> Vector:
        """θ of the estimate, then with the best back-offs found so far, (n_θ,)."""
        if self._search is None or len(self._history) < 2:
            return self._found
        return self._search.theta.theta

    @property
    def _reported(self) -> Parameters:
        return self._start.with_theta(self._found)

    def told(self) -> Told:
        """What the episode told; the estimate's θ."""
        return super().told() if self._history else {"theta": self.conclude().theta}

    def observe(self, transition: Transition | None, cost: float = 0.0) -> Update | None:
        """Take one sample of the estimation or of the search."""
        found = None if transition is None or self._history else self.learn(transition)
        update = super().observe(transition, cost)
        if update is None and found is not None:
            update = moved(found.blocks, self.controller.theta, found.theta)
            self._found = self.controller.theta = found.theta
        return update

    def backed_off(self, parameters: Parameters, errors: Matrix) -> Parameters:
        """θ in operation, its bounds set back by the greatest of its prediction errors (K, n).

        None of these would have led from within θ's bounds to beyond the scenario's. Bounds that
        would cross stay.
        """
        if self.asks_for == "simulator" or not self.configuration.back_off:
            return parameters
        lower = self.scenario.state_lower + np.maximum(-errors.min(axis=0), 0.0)
        upper = self.scenario.state_upper - np.maximum(errors.max(axis=0), 0.0)
        crossed = lower >= upper
        lower, upper = (
            np.where(crossed, parameters[name], bound)
            for name, bound in (("x_l", lower), ("x_u", upper))
        )
        return parameters.replace({"x_l": lower, "x_u": upper})


class OffsetFree(Estimate):
    """c_f ← mean of s₊ − f(s, a), the integrating disturbance model of offset-free MPC.

    With `back_off` the bounds stand back by the greatest of the last `memory` errors about that
    mean; while fewer are known, by the start's back-off where that is more.
    """

    Configuration = OffsetFreeConfiguration
    KEPT = (*Estimate.KEPT, "_offset", "_seen", "_errors")

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._model = OneStepModel(self.scenario)
        self._parameters = self._model.parameters(self._start)
        self._offset = self._start["c_f"]
        self._errors = np.zeros((self.configuration.memory, len(self._offset)))
        self._seen = 0

    def learn(self, transition: Transition) -> Parameters | None:
        """Filter the error of one prediction."""
        predicted = self._model.predict(transition.s, transition.a, self._parameters)[0]
        error = transition.next_s - predicted
        self._errors[self._seen % len(self._errors)] = error
        self._seen += 1
        weight = 1.0 / min(self._seen, len(self._errors))
        self._offset = self._offset + weight * (error - self._offset)
        return None if self._seen % self.configuration.update_every else self.conclude()

    def conclude(self) -> Parameters:
        """θ with the offset and the back-off as they are."""
        start, errors = self._start, self._errors[: self._seen] - self._offset
        if not len(errors):
            return self._reported
        found = self.backed_off(self._reported.replace({"c_f": self._offset}), errors)
        if self._seen >= len(self._errors) or not self.configuration.back_off:
            return found
        lower = np.maximum(found["x_l"], start["x_l"])
        upper = np.minimum(found["x_u"], start["x_u"])
        return found.replace({"x_l": lower, "x_u": upper}) if (lower < upper).all() else found


class OffsetFreeSimulator(OffsetFree):
    """`OffsetFree`, then a search of the back-off with the plant put back, c_f held."""

    asks_for = "simulator"


class Identified(Estimate):
    """p̂ = argmin Σ ‖(s₊ − f(s, a; p))/σ‖², the prediction-error method, carried in θ's block p.

    σ is the standard deviation of the errors at the start's parameters. Then the cost is tuned at
    the fitted model's optimal steady state, and the bounds are backed off by the greatest of the
    fitted model's errors. In operation this is done every eight hours.
    """

    Configuration = IdentifiedConfiguration
    KEPT = (*Estimate.KEPT, "_rows")

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._model = OneStepModel(self.scenario)
        self._rows: list[Vector] = []
        self._every = self.configuration.every
        if self._every is None and self.asks_for == "operation":
            self._every = max(round(SHIFT / self.scenario.sampling_time), 1)

    def learn(self, transition: Transition) -> Parameters | None:
        """Keep a transition; the last of every `every` gives a new fit."""
        self._rows.append(np.concatenate([transition.s, transition.a, transition.next_s]))
        if len(self._rows) != self._every:
            return None
        fitted = self.conclude()
        self._rows.clear()
        return fitted

    def conclude(self) -> Parameters:
        """θ with the fitted p, and the cost tuned with it.

        Raises DivergenceError where the fitted model has no economically optimal steady state.
        """
        start = self._reported
        if "p" not in start.blocks or not self._rows:
            return start
        n, rows = self._problem.n_states, np.array(self._rows)
        transitions = rows[:, :n], rows[:, n:-n], rows[:, -n:]
        fitted = start.replace({"p": self._fit(start, *transitions)})
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
        tuned = tuned.replace({name: start[name] for name in kept if name in start.blocks})
        return self.backed_off(tuned, self._model.errors(*transitions, tuned))

    def _fit(self, start: Parameters, states: Matrix, actions: Matrix, following: Matrix) -> Vector:
        """p̂, (n_p,), from `start`."""
        indices = self._problem.model.parameter_indices(start.blocks.block("p").labels)
        values, nominal = self._model.parameters(start), self._problem.model.nominal_parameters
        unit = np.where(nominal[indices] != 0, np.abs(nominal[indices]), 1.0)
        sigma = self._model.errors(states, actions, following, start).std(axis=0)
        sigma = np.maximum(sigma, np.finfo(float).tiny)

        def residuals(scaled: Vector) -> Vector:
            values[indices] = scaled * unit
            predicted = self._model.predict(states, actions, values) + start["c_f"]
            return np.asarray(((following - predicted) / sigma).reshape(-1))

        return np.asarray(least_squares(residuals, start["p"] / unit).x * unit)


class IdentifiedSimulator(Identified):
    """`Identified`, then a search of the back-off with the plant put back."""

    asks_for = "simulator"


class Held(Algorithm):
    """θ stays at its start: the baseline of learning in operation."""

    Configuration = GreedyConfiguration
    explores = False
