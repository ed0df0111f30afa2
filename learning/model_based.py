"""`model-based`: θ searched on a model of the plant that its own operation has taught.

The cost is tuned on the nominal model, and c_f is what this lacks on average on the plant, as in
offset-free control. Parameters of its model that θ has, all by default, are the fitted ones. What
is searched are the back-offs of the state bounds. A θ costs what the empirical model promises: the
mean stage cost of one long rollout and the expectation of the penalty over all errors of
prediction. Of back-offs between which the model cannot tell the smallest is taken, but where a
bound does not bind, which costs nothing: there it is a spare one, against a plant that changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from controllers.economic import tune
from controllers.errors import TuningError
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.protocols import Array
from learning.algorithm import Algorithm, Transition, Update
from learning.configuration import ALL, Configuration, Count, ModelParameters
from learning.empirical_model import (
    GROWTH,
    WINDOWS,
    EmpiricalModel,
    Features,
    PlantData,
    Rollout,
)
from learning.prediction_errors import SortedErrors, expected_penalties
from learning.step import moved

BURN, COARSE, FINE = 300, 1800, 5300
"""Samples of a rollout before it counts, of a short one, and of a long one."""
LEVELS = (0.0, 2.0, 3.0, 7.0, 18.0, 50.0)
"""Back-offs of the grid, in standard deviations of the one-step error."""
SWEEPS = ((COARSE, (0.72, 0.85, 1.18, 1.4)), (FINE, (0.93, 1.07)), (FINE, (0.97, 1.03)))
"""Samples of a rollout, and factors of a back-off, in the three sweeps about the best point."""
ROOM = 0.45
"""Largest back-off, as a share of the distance of the bounds."""
DOUBT = 1.0
"""Standard deviations of a difference of costs within which the model cannot tell."""
PLATEAU = 2e-5
"""Least deviation of such a difference, as a share of the cost."""
WORTH = 1e-6
"""Share of the cost that the penalty of a bound must reach for its back-off to be searched."""
TAIL, TAIL_SAMPLES = 0.1, 120
"""The errors' tails are widened by `TAIL` √(`TAIL_SAMPLES` / their number)."""
SETTLING = 30
"""Samples after an update that do not break its promise, which is of a loop that has settled."""
BROKEN = 1.5
"""Excess of such a mean cost, over that of the promise's dearest window, that breaks a promise."""
REACH = 2.0
"""Ranges of the latest states by which a rollout's mean may differ from theirs."""
CAUTION = 120
"""Samples of the present plant below which back-offs only grow; errors below which none tells."""
STEADY = 1440
"""Samples of a changed plant below which no back-off shrinks beneath what it was before."""
SHRINKS = 0.7
"""A back-off shrinks at most to this share of the least distance from its bound so far."""
RECENT = 1440
"""Latest samples by which the size of the errors is measured."""
THINNED = 10
"""Of so many samples of a rollout one tells what the model knows of it."""


class ModelBasedConfiguration(Configuration):
    """Hyperparameters of `model-based`."""

    model_parameters: ModelParameters = ALL
    first_update: Count = Field(30, description="samples before the first update of θ")
    longest_interval: Count = Field(
        1440,
        description="most samples between updates, which double with the model's data, as long as "
        "these are no more than eight times as many",
    )
    memory: Count = Field(20_000, description="samples that the model remembers")
    exploration_samples: Count = Field(120, description="samples at the start that explore")
    spare: float = Field(
        18.0,
        ge=0,
        description="back-off of a bound that does not bind, in standard deviations of the "
        "one-step error; half or none of it where that would cost",
    )


class ModelBased(Algorithm):
    """Operates with θ, fits the empirical model, searches on it, and operates on.

    An update is due when the model's data have doubled, at the latest after `longest_interval` or
    an eighth of them; and as soon as samples are dearer than any of the rollout that promised θ's
    cost. Where the errors since the last update have a mean that the model makes improbable, the
    plant has changed, and the data from there on count. θ moves only where the model, on new noise,
    promises less for the new one.
    """

    Configuration = ModelBasedConfiguration
    KEPT = ("back_off", "_due", "model_samples", "_limits", "_floor", "_era", "_data")
    configuration: ModelBasedConfiguration
    budget: ClassVar[int] = 10_080

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings, start = self.configuration, self.controller.parameters
        self._problem = problem = Problem.from_scenario(self.scenario)
        self._base = base = _tuned(problem, start)
        self._features = Features(problem)
        labels = start.blocks.block("p").labels if "p" in start.blocks else ()
        self._carried = problem.model.parameter_indices(labels)
        self._rollout = Rollout(problem, start, self._features)
        self._data = PlantData(self._features, settings.memory)
        backed = np.concatenate([start["x_l"] - base["x_l"], base["x_u"] - start["x_u"]])
        self.back_off: Array = np.maximum(backed, 0.0)
        """Back-offs of θ, of lower then upper bounds, (2n,)."""
        self._due = settings.first_update  # samples at the next update
        # Samples before the plant of the latest update, and the back-offs when that plant began.
        self._era, self._floor = 0, np.zeros_like(self.back_off)
        self._limits: Array = np.full(len(WINDOWS), np.inf)  # of the mean cost, for each window
        self.model_samples = 0
        """Samples of the model that its rollouts have taken so far."""

    @property
    def explores(self) -> bool:
        """Whether the samples explore now."""
        return self._data.count < self.configuration.exploration_samples

    def observe(self, transition: Transition) -> Update | None:
        """Keep a transition; move θ when an update is due."""
        data = self._data
        data.add(transition)
        judged = (data.count - data.fitted) % WINDOWS[0] == 0
        alarmed = judged and data.model is not None and self._alarmed(data.model)
        return self._update(alarmed) if alarmed or data.count >= self._due else None

    def _alarmed(self, model: EmpiricalModel) -> bool:
        """Whether the promise is broken or, on new data, the plant is another."""
        data = self._data
        if len(model.residuals) < CAUTION:
            return False
        predicted, h, errors, designs = data.errors()
        costs = ExpectedCosts(self._problem, model)(predicted, h)[0]
        settled = len(costs) > SETTLING
        broken = [
            window
            for window, limit in zip(WINDOWS, self._limits, strict=True)
            if settled and window <= len(costs) and costs[-window:].mean() > limit
        ]
        return data.changed(errors, designs, broken) or bool(broken)

    def _least(self, present: Array, inputs: Array) -> Array:
        """Least back-offs (2n,) that inputs (s, a) of the present plant, (M, n+m), allow.

        A present one shrinks little beyond the state that came closest to its bound: what lies
        behind it the model only extrapolates. Of few samples none shrinks, nor while they explore,
        which no rollout does. A plant that has changed may go on to: until it has been the same for
        `STEADY` samples none shrinks below what it was before.
        """
        problem = self._problem
        if self.explores or len(inputs) < CAUTION:
            return present
        changing = self._era > 0 and len(inputs) < STEADY
        floor = np.minimum(self._floor, present) if changing else np.zeros_like(present)
        states = inputs[:, : problem.n_states]
        rooms = np.concatenate([states - problem.state_lower, problem.state_upper - states], axis=1)
        least: Array = np.clip(SHRINKS * rooms.min(axis=0), floor, present)
        return least

    def _corrected(
        self, present: Parameters, model: EmpiricalModel, inputs: Array
    ) -> tuple[Parameters, Array]:
        """θ before its back-offs, and what the controller's predictions of s₊ gain by it, (n,).

        Its model parameters are the fitted ones, c_f is what is lacking with them on average at
        inputs (M, n+m) of the present plant. Of few samples the present ones stay.
        """
        kept = {name: present[name] for name in ("p", "c_f") if name in present.blocks}
        if len(inputs) < CAUTION:
            return self._base.replace(kept), np.zeros_like(present["c_f"])
        before, after = np.zeros(self._features.count), np.zeros(self._features.count)
        if "p" in kept:
            nominal = self._problem.model.nominal_parameters[self._carried]
            before[self._carried] = kept["p"] / nominal - 1
            after[self._carried] = model.mean[self._carried]
            kept["p"] = nominal * (1 + after[self._carried])
        kept["c_f"] = model.lack(inputs, after)
        return self._base.replace(kept), model.lack(inputs, before) - present["c_f"]

    def _update(self, alarmed: bool) -> Update:
        data, longest = self._data, self.configuration.longest_interval
        model = data.fit()
        inputs, _ = data.present
        age = data.count - data.era
        if data.era != self._era:
            self._era, self._floor = data.era, self.back_off
        # Day by day an optimum moves little: then the search begins at the present back-offs.
        settled = age > longest and not alarmed and np.isfinite(self._limits).all()
        interval = min(age, max(longest, age // GROWTH))
        self._due = data.count + max(interval, self.configuration.first_update)
        latest, _ = data.latest(RECENT)
        spare, rng = self.configuration.spare, self.rng
        present = self.controller.parameters
        base, more = self._corrected(present, model, inputs[-RECENT:])
        kept = np.maximum(self.back_off + np.concatenate([more, -more]), 0.0)
        search = BackOffs(self._problem, self._rollout, base, model, latest, spare, rng)
        found = search.best(kept, self._least(kept, inputs), () if settled else LEVELS)
        new = search.theta(found)
        search.draw(FINE)
        promise, held = search.promises([new, present.theta])
        better = search.excess(promise, held) <= 0
        self._limits = (promise if better else held).limits
        if not np.isfinite(self._limits).all():
            self._due = min(self._due, data.count + WINDOWS[-2])
        if better:
            self.back_off = found
            self.controller.theta = new
        self.model_samples += search.samples
        end = self.controller.theta
        return moved(present.blocks, present.theta, end, refused=not better)


class Promise(NamedTuple):
    """Mean `cost` that a model promises, and its derivative by the model's coefficients, `row`.

    `limits` are those of the mean cost of so many samples as each of `WINDOWS`.
    """

    cost: float
    row: Array
    limits: Array


class ExpectedCosts:
    """Costs of samples that a model predicts, the penalty by its expectation over all residuals."""

    def __init__(self, problem: Problem, model: EmpiricalModel) -> None:
        self.penalty = problem.penalty
        errors = model.residuals[:, : problem.n_states]
        self._errors = SortedErrors(errors)
        self._widened = 1 + TAIL * (TAIL_SAMPLES / len(errors)) ** 0.5

    def __call__(self, predicted: Array, h: Array) -> tuple[Array, Array]:
        """Costs (M,), and the penalty of each bound in it, (2n, M), of predictions and h (M, K)."""
        due = expected_penalties(self.penalty, predicted[:, :-1], self._errors, self._widened * h)
        penalties = due.swapaxes(0, 1).reshape(-1, len(predicted))
        return predicted[:, -1] + penalties.sum(axis=0), penalties


class BackOffs:
    """Searches back-offs δ (2n,) of the lower, then the upper state bounds on an empirical model.

    `visited` are the latest inputs (s, a), (M, n+m), oldest first; rollouts begin at the last one's
    state, and are lost where they cost more on average than the dearest of these samples, or their
    mean state is far from that of `RECENT` of them: the model has gone where the plant has not
    been. All θ meet the same noise until the next `draw`. δ are multiples of a twentieth of the
    error's order of magnitude, so that no last digit decides. `spare` is the back-off, in standard
    deviations of the error, of a bound that does not bind.
    """

    def __init__(
        self,
        problem: Problem,
        rollout: Rollout,
        base: Parameters,
        model: EmpiricalModel,
        visited: Array,
        spare: float,
        rng: np.random.Generator,
    ) -> None:
        n = problem.n_states
        self._spare = spare
        self._problem, self._rollout, self._base, self._model = problem, rollout, base, model
        self._start, self._rng = visited[-1, :n], rng
        self._costs = ExpectedCosts(problem, model)
        predicted, h, _ = model.predict(visited)
        self._dearest = self._costs(predicted, h)[0].max()
        states = visited[:, :n]
        self._centre, self._reach = states.mean(axis=0), REACH * np.ptp(states, axis=0)
        if len(visited) < RECENT:  # the plant has not settled yet
            self._reach[:] = np.inf
        deviation = model.residuals[:, :n].std(axis=0) * h[:, :n].mean(axis=0)
        self._unit = np.tile(np.maximum(deviation, 1e-6 * problem.units.state), 2)
        self._most = np.tile(ROOM * (problem.state_upper - problem.state_lower), 2)
        self._worth = np.zeros(2 * n)  # largest penalty of each bound so far, as a share of cost
        self.samples = 0
        self.draw(COARSE)

    def draw(self, steps: int) -> None:
        """Take new noise for rollouts of so many samples."""
        residuals = len(self._model.residuals)
        self._picks = self._rng.integers(residuals, size=steps, dtype=np.int32)
        self._known: dict[bytes, Promise] = {}  # on this noise, by θ

    def theta(self, delta: Array) -> Array:
        """θ with its bounds backed off by δ."""
        n, base = self._problem.n_states, self._base
        moved = {"x_l": base["x_l"] + delta[:n], "x_u": base["x_u"] - delta[n:]}
        return base.replace(moved).theta

    def promises(self, thetas: Sequence[Array]) -> list[Promise]:
        """What the model promises of each θ; infinite cost where the rollout is lost."""
        new = {key: theta for theta in thetas if (key := theta.tobytes()) not in self._known}
        rollouts = self._rollout(list(new.values()), self._start, self._model, self._picks)
        self._known |= {
            key: self._promise(*parts) for key, parts in zip(new, rollouts, strict=True)
        }
        return [self._known[theta.tobytes()] for theta in thetas]

    def _promise(self, *parts: Array) -> Promise:
        model = self._model
        self.samples += len(parts[0])
        inputs, predicted, h = (part[BURN:] for part in parts)
        lost = Promise(np.inf, np.zeros_like(model.mean), np.full(len(WINDOWS), np.inf))
        if len(inputs) < len(self._picks) - BURN or not np.isfinite(predicted).all():
            return lost
        costs, penalties = self._costs(predicted, h)
        stage, cost = float(predicted[:, -1].mean()), float(costs.mean())
        size = max(abs(stage), np.finfo(np.float64).eps)
        self._worth = np.maximum(self._worth, penalties.mean(axis=1) / size)
        away = np.abs(inputs[:, : len(self._start)].mean(axis=0) - self._centre)
        if cost > self._dearest or (away > self._reach).any():
            return lost
        dearest = np.array([_moving_mean(costs, window).max(initial=cost) for window in WINDOWS])
        limits = cost + BROKEN * (dearest - cost)
        return Promise(cost, model.cost_row(inputs[::THINNED]), limits)

    def excess(self, one: Promise, other: Promise) -> float:
        """Cost of one above another's, in deviations of what the model knows of the difference."""
        if not np.isfinite(one.cost):
            return np.inf
        row = one.row - other.row
        deviation = float(row @ self._model.covariance @ row) ** 0.5
        return float((one.cost - other.cost) / max(deviation, PLATEAU * abs(one.cost)))

    def best(self, delta: Array, least: Array, levels: Sequence[float]) -> Array:
        """The smallest δ, not below `least`, whose cost the model cannot tell from the least one.

        First a grid of `levels`, in standard deviations of the one-step error, at once over the
        bounds whose penalty shows anywhere, up to two, and one by one over what others there are;
        without levels δ alone. Then sweeps over each about the best point, on longer rollouts.
        Bounds whose penalty shows nowhere have a spare back-off.
        """
        grids = [
            self._rounded(i, [max(level * unit, least[i]) for level in levels])
            for i, unit in enumerate(self._unit)
        ]
        active: list[int] = []
        points = [delta, least]
        while True:
            delta = self._least(points)
            order = np.argsort(-self._worth)
            new = [int(i) for i in order if self._worth[i] > WORTH and i not in active]
            if not new:
                break
            active.append(new[0])
            together = active if len(active) <= 2 else active[-1:]
            corners = product(*(grids[i] for i in together))
            points = [delta, *(_with(delta, together, corner) for corner in corners)]
        for steps, factors in SWEEPS:
            if steps > len(self._picks):
                self.draw(steps)
            for i in active:
                wanted = [delta[i] * factor for factor in factors] if delta[i] else [self._unit[i]]
                values = self._rounded(i, [max(value, least[i]) for value in wanted])
                delta = self._least([delta, *(_with(delta, [i], [value]) for value in values)])
        for i in set(range(len(delta))) - set(active):
            delta = self._spared(delta, i)
        return delta

    def _spared(self, delta: Array, i: int) -> Array:
        """δ with as much of the spare back-off of a bound that does not bind as costs nothing."""
        values = self._rounded(i, [share * self._spare * self._unit[i] for share in (0.5, 1.0)])
        points = [delta, *(_with(delta, [i], [value]) for value in values if value > delta[i])]
        promises = self.promises([self.theta(point) for point in points])
        free = [self.excess(promise, promises[0]) <= DOUBT for promise in promises]
        return points[max(np.flatnonzero(free), default=0)]

    def _rounded(self, i: int, values: Sequence[float]) -> list[float]:
        """Back-offs of a bound as multiples of its step, within its room, ascending."""
        step = 10.0 ** np.floor(np.log10(self._unit[i])) / 20
        return sorted({float(min(round(v / step) * step, self._most[i])) for v in values})

    def _least(self, points: Sequence[Array]) -> Array:
        promises = self.promises([self.theta(point) for point in points])
        least = min(promises, key=lambda promise: promise.cost)
        told = [self.excess(promise, least) <= DOUBT for promise in promises]
        close = [point for point, like in zip(points, told, strict=True) if like]
        return min(close or points[:1], key=lambda point: float((point / self._unit).sum()))


def _moving_mean(costs: Array, window: int) -> Array:
    total: Array = np.concatenate([[0.0], costs]).cumsum()
    return (total[window:] - total[:-window]) / window


def _with(delta: Array, bounds: Sequence[int], values: Sequence[float]) -> Array:
    changed = delta.copy()
    changed[list(bounds)] = values
    return changed


def _tuned(problem: Problem, start: Parameters) -> Parameters:
    """θ with the cost tuned on the nominal model and the true bounds, all else the start's."""
    try:
        tuned = tune(problem, start.blocks).parameters
    except TuningError:
        return start
    kept = ("c_lambda", "c_f", "w_sigma", "W_sigma", "p")
    return tuned.replace({name: start[name] for name in kept if name in start.blocks})
