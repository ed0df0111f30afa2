"""The practitioner's methods, from plant data: back-off, offset, parameters of the model.

In operation (`BackOff`, `OffsetFree`, `Identified`) offset and parameters are estimated to the end
of the run. On a simulator (`…Simulator`) a `BackOffSearch` follows the estimate; the plant is reset
before each of its stretches, on the same noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
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
from learning.configuration import Configuration, Count
from learning.episodes import Episode, Planned, Told, numbers
from learning.errors import ConfigurationError, DivergenceError
from learning.prediction_errors import OneStepModel, PredictionErrors, known_penalty
from learning.step import moved

BackOffToo = Annotated[bool, Field(description="search the back-off of the active bounds")]
ESTIMATION = 0.25
"""Share of the samples for the estimate that comes before a search."""
SHIFT = 8 * 3600.0
"""Seconds between two identifications, unless told otherwise."""
PHASES = ((3, (0.0, 2.0, 4.0)), (5, (-0.5, 0.0, 0.5)), (8, (-0.25, 0.25)))
"""Sixteenths of a bound's samples, and back-offs κ about the best so far, of each round."""
REACH = 1.0
"""How far, in κ, a sample speaks for another back-off; twice that in the coarse first round."""
RESOLUTION = 0.01
PLATEAU = 1e-6
"""Estimated costs that differ by this share are one, so that no last digit decides."""
SEGMENTS = 16
"""The budget has that many of the first round's stretches."""
BINDING = 0.05
"""Share of the samples in which a bound must bind to count as active."""


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
        return super().learned_parameters(model) or model.uncertain


class BackOffSearch:
    """Finds the κ of least cost for the active bounds x_l + κσ and x_u − κσ.

    σ is the standard deviation of the model's one-step prediction error in each state; a bound is
    active where it binds in the QP (dV/dx_l or dV/dx_u ≠ 0) in `BINDING` of the samples. Each has a
    line search of three rounds (docs/method.md). The bound that binds most often at κ = 0 has the
    first round, which finds the others, and the last two. No true bound is loosened. Of back-offs
    whose estimates differ by less than `PLATEAU` the smallest is taken. Where the estimate falls to
    the end of its range, the best back-off that was run is taken, the next round is about it, and
    the round's last segment is `refused`. `start` is θ with no bound backed off; it may be set
    until the `plan` begins. Raises ConfigurationError on a budget that is too small.
    """

    def __init__(
        self, start: Parameters, scenario: Scenario, budget: int, rng: np.random.Generator
    ) -> None:
        problem = Problem.from_scenario(scenario)
        least = 2 * SEGMENTS * problem.horizon
        if budget < least:
            raise ConfigurationError(
                f"a search of the back-off needs at least {least} samples, it has {budget}"
            )
        self.start, self._budget = start, budget
        self._penalty, self._model = scenario.state_penalty, OneStepModel(scenario)
        self._settling = problem.horizon
        self._n = n = problem.n_states
        self._columns = 3 + 2 * n + problem.n_actions
        places, slices = np.arange(start.theta.size), start.blocks.slices
        self._bounds = np.concatenate([places[slices["x_l"]], places[slices["x_u"]]])
        self._true = (scenario.state_lower, scenario.state_upper)
        self._seeds = rng.integers(2**63, size=2 * n * len(PHASES)).tolist()
        self.kappa = np.zeros(2 * n)
        """Best back-offs found, of lower then upper bounds, (2n,)."""
        self._unit = np.zeros(n)

    @property
    def theta(self) -> Parameters:
        """θ with the best back-offs found."""
        return self.at(self.kappa)

    def at(self, kappa: Vector) -> Parameters:
        """θ with its bounds κ (2n,) backed off, within the true bounds, x_l kept below x_u."""
        lower = np.maximum(self.start["x_l"] + kappa[: self._n] * self._unit, self._true[0])
        upper = np.minimum(self.start["x_u"] - kappa[self._n :] * self._unit, self._true[1])
        crossed = lower >= upper
        middle = (lower + upper) / 2
        lower[crossed], upper[crossed] = middle[crossed] - 1e-6, middle[crossed] + 1e-6
        return self.start.replace({"x_l": lower, "x_u": upper})

    def told(self, segment: Episode) -> Told:
        """Rows of a segment, and how often each bound bound, (2n,), where that was measured."""
        binding = np.reshape(segment.measured, (-1, 2 * self._n)).sum(axis=0) / segment.length
        return {"rows": segment.samples(self._columns), "binding": binding}

    def _segment(self, number: int, steps: int, kappa: Vector) -> Episode:
        """A stretch of operation; in the first round the bounds that bind are counted."""
        segment = Episode(self.at(kappa).theta, steps, self._seeds[number])
        if not number:
            segment.measure = lambda sample, _: sample.policy.value_gradient[self._bounds] != 0
        return segment

    def plan(self) -> Iterator[Episode]:
        """The whole search; the segments of a round meet the same noise."""
        n = self._n
        yield (segment := self._segment(0, self._budget // SEGMENTS, self.kappa))
        rows, share = segment.answer["rows"], segment.answer["binding"]
        if not len(rows) or share.max() < BINDING:
            return
        states, following = rows[:, 3 : 3 + n], rows[:, -n:]
        errors = self._model.errors(states, rows[:, 3 + n : -n], following, self.start)
        self._unit = errors.std(axis=0)
        first = int(np.argmax(share))
        schedule, tried = [(first, 0)], [self._settled(segment, 0, 0.0)]
        for number, (bound, phase) in enumerate(schedule):
            if number and phase != 2:  # the second round's samples count in the third one too
                tried = []
            left = 13 / sum(PHASES[later][0] for _, later in schedule[1:]) if number else 1.0
            steps, kappas = self._segments(bound, phase, left)
            for kappa in kappas[0 if number else 1 :]:
                yield (segment := self._segment(number, steps, kappa))
                tried.append(self._settled(segment, number, kappa[bound]))
                share = share if number else np.maximum(share, segment.answer["binding"])
            self.kappa[bound], segment.refused = self._best(bound, phase, np.concatenate(tried))
            if not number:
                others = [int(i) for i in np.flatnonzero(share >= BINDING) if i != first]
                schedule += [(other, phase) for other in others for phase in range(3)]
                schedule += [(first, 1), (first, 2)]

    def _settled(self, segment: Episode, number: int, kappa: float) -> Matrix:
        """Round, κ, stage cost and state, (K, 3+n), of a segment once the loop has settled."""
        rows = segment.answer["rows"]
        rows = rows[rows[:, 0] >= self._settling][:, [1, *range(3, 3 + self._n)]]
        return np.hstack([np.full((len(rows), 2), (number, kappa)), rows])

    def _segments(self, bound: int, phase: int, left: float) -> tuple[int, list[Vector]]:
        """Samples of each segment of a round, and their back-offs."""
        share, offsets = PHASES[phase]
        # The first round is about one bound; later rounds share the samples that it leaves.
        steps = int(self._budget * left * share / (SEGMENTS * len(offsets)))
        if phase == 0 and (least := max(self._least(bound), -offsets[-1])) < -1.0:
            offsets = (0.0, least, least / 2)  # of a start that is backed off, look for less
        kappas = [self.kappa.copy() for _ in offsets]
        for kappa, offset in zip(kappas, offsets, strict=True):
            kappa[bound] = max(kappa[bound] + offset, self._least(bound))
        return max(steps, self._settling + 1), kappas

    def _least(self, bound: int) -> float:
        """κ of the true bound; at most 0 if the start loosens no bound."""
        state, upper = bound % self._n, bound >= self._n
        room = (
            self.start["x_u"][state] - self._true[1][state]
            if upper
            else self._true[0][state] - self.start["x_l"][state]
        )
        return float(room / self._unit[state]) if self._unit[state] > 0 else 0.0

    def _best(self, bound: int, phase: int, tried: Matrix) -> tuple[float, bool]:
        """κ of least estimated cost of a bound, and whether the estimate led beyond what was tried.

        `tried` are rows of `_settled`.
        """
        n = self._n
        if not len(tried):  # the controller failed in all of them
            return float(self.kappa[bound]), False
        kappa, costs, states = tried[:, 1], tried[:, 2], tried[:, 3:]
        slope = self._slopes(tried[:, 0], kappa, tried[:, 2:])
        slope[1 + bound % n] = self._unit[bound % n] * (1 if bound < n else -1)
        reach = REACH * (2 if phase == 0 else 1)

        def estimate(value: float) -> float:
            near = np.abs(kappa - value) < reach + RESOLUTION / 2
            moved = states[near] + np.outer(value - kappa[near], slope[1:])
            return float(slope[0] * value + known_penalty(self._penalty, moved).mean())

        def best_of(values: Vector) -> float:
            costs = mean + np.array([estimate(value) for value in values])
            plateau = values[costs <= costs.min() + PLATEAU * abs(costs.min())]
            return float(plateau[np.argmin(np.abs(plateau))])

        mean, least = float(costs.mean()), self._least(bound)
        low, high = max(kappa.min() - reach, least), kappa.max() + reach
        # Multiples of the resolution, so that a start in its last digits has the same grid.
        steps = np.arange(np.ceil(low / RESOLUTION), np.floor(high / RESOLUTION) + 1)
        grid = RESOLUTION * steps
        found = best_of(grid)
        if found == grid[-1] or (found == grid[0] and low > least):
            return best_of(np.unique(kappa)), True
        return found, False

    @staticmethod
    def _slopes(rounds: Vector, kappa: Vector, values: Matrix) -> Vector:
        """d/dκ of each column's mean, (1+n,), within the rounds."""
        above, below = np.zeros(values.shape[1]), 0.0
        for number in np.unique(rounds):
            mine = rounds == number
            centred = kappa[mine] - kappa[mine].mean()
            above += centred @ values[mine]
            below += float(centred @ centred)
        return np.asarray(above / below if below > 0 else above)


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

    def told(self) -> Told:
        """What the segment told."""
        return self._search.told(self._episode)


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
        samples = self.samples
        if self.asks_for == "simulator" and self.configuration.back_off:
            samples = max(round(ESTIMATION * self.samples), 1)
            left = self.samples - samples
            self._search = BackOffSearch(self._start, self.scenario, left, self.rng)
        self.follow(self._estimate_and_search(samples))

    def _estimate_and_search(self, samples: int) -> Iterator[Episode]:
        if self.asks_for == "operation":
            return  # the estimation does not end
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
        """The estimate's θ, then what a segment of the search told."""
        if self._search is None or not self._history:
            return {"theta": self.conclude().theta}
        return self._search.told(self._episode)

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
    KEPT = (*Estimate.KEPT, "_offset", "_errors")

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._model = OneStepModel(self.scenario)
        self._parameters = self._model.parameters(self._start)
        self._offset = self._start["c_f"]
        self._errors = PredictionErrors(self.scenario, self.configuration.memory)

    def learn(self, transition: Transition) -> Parameters | None:
        """Filter the error of one prediction."""
        predicted = self._model.predict(transition.s, transition.a, self._parameters)[0]
        error = transition.next_s - predicted
        self._errors.add(error)
        weight = 1.0 / len(self._errors.values)
        self._offset = self._offset + weight * (error - self._offset)
        return None if self._errors.count % self.configuration.update_every else self.conclude()

    def conclude(self) -> Parameters:
        """θ with the offset and the back-off as they are."""
        start, errors = self._start, self._errors.values - self._offset
        if not len(errors):
            return self._reported
        found = self.backed_off(self._reported.replace({"c_f": self._offset}), errors)
        if len(errors) == self.configuration.memory or not self.configuration.back_off:
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
        self._rows: list[list[float]] = []
        self._every = self.configuration.every
        if self._every is None and self.asks_for == "operation":
            self._every = max(round(SHIFT / self.scenario.sampling_time), 1)

    def learn(self, transition: Transition) -> Parameters | None:
        """Keep a transition; the last of every `every` gives a new fit."""
        self._rows.append(numbers(transition))
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
            replace(quantity, nominal=float(value))
            for quantity, value in zip(model.parameters, values, strict=True)
        )
        identified = replace(model, parameters=quantities)
        problem = replace(self._problem, model=identified)
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
