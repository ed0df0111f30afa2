"""`model-based`: θ searched on a model of the plant that its own operation has taught.

The cost is tuned on the nominal model, and c_f is the mean prediction error of this on the plant,
as in offset-free control. Parameters of its model that θ has, all by default, are the fitted ones.
What is searched are the back-offs of the state bounds. A θ costs what the empirical model predicts:
the mean stage cost of one long rollout and the expectation of the penalty over all errors of
prediction. Of back-offs between which the model cannot tell the smallest is chosen, but where a
bound is not active, which costs nothing: there it is a reserve, against a plant that changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field
from scipy.special import ndtr, stdtrit

from controllers.economic import tune
from controllers.errors import TuningError
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.protocols import Array
from cosim.core.scenario import NonNegative, Positive
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import ALL, Count, ModelParameters, Share
from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration, Features
from learning.known_signals import KnownSignals
from learning.model_from_outputs import ModelFromOutputs
from learning.plant_data import PlantData
from learning.prediction_errors import SortedErrors, expected_penalties
from learning.rollout import Rollout, RolloutSamples
from learning.step import update_without_fit


class ModelBasedConfiguration(EmpiricalModelConfiguration):
    """Hyperparameters of `model-based`."""

    model_parameters: ModelParameters = ALL
    # under sensors (`learning.model_from_outputs`)
    noise: bool = Field(True, description="put the estimator's variances into θ, under sensors")
    margin: bool = Field(
        False,
        description="put back-offs that follow the estimate's deviation into θ, under sensors",
    )
    noise_prior: Positive = Field(
        0.5,
        description="standard deviation of the prior of these variances' logarithms",
    )
    output_samples: Count = Field(
        4320,
        description="latest samples to whose readings filter and model are fitted",
    )
    fit_noise_rounds: Count = Field(15, description="rounds of that fit")
    simulated_samples: Count = Field(
        1500,
        description="samples of a rollout behind the filter, `burn_in` included",
    )
    normal_errors: Count = Field(
        60,
        description="weight of the estimate's normal law, in numbers of observed errors",
    )
    back_off_step: Positive = Field(
        1.0,
        description="first step of a back-off in the search under sensors, in deviations of the "
        "predicted state; it is halved twice",
    )
    largest_margin: Positive = Field(
        4.0,
        description="most deviations of the estimate by which the search tightens a bound",
    )
    shrink_samples: Count = Field(
        480,
        description="samples below which no back-off shrinks, under sensors",
    )
    largest_bias: Positive = Field(
        1.0,
        description="mean of a sensor's innovations, in their expected deviations, above which no "
        "noise explains the readings and θ stays",
    )
    least_biased_readings: Count = Field(
        30,
        description="readings of a sensor below which that mean is chance",
    )
    # when an update is due
    first_update: Count = Field(30, description="samples before the first update of θ")
    longest_interval: Count = Field(
        1440,
        description="most samples between updates, which double with the model's data, as long as "
        "these are no more than `refit_growth` times as many",
    )
    exploration_samples: Count = Field(120, description="samples at the start that explore")
    settling_samples: Count = Field(
        30,
        description=(
            "samples after an update that are not compared with the predicted cost: the "
            "loop settles"
        ),
    )
    cost_excess: Positive = Field(
        1.5,
        description="excess of a window's mean cost, over that of the rollout's worst window, at "
        "which an update is due",
    )
    # what back-offs are possible
    reserve_back_off: NonNegative = Field(
        18.0,
        description=(
            "reserve back-off of an inactive bound, in standard deviations of the one- "
            "step error; half of it or none if it raises the predicted cost"
        ),
    )
    least_samples: Count = Field(
        120,
        description="samples of the present regime below which back-offs only grow; errors below "
        "which none calls for an update",
    )
    steady_samples: Count = Field(
        1440,
        description=(
            "samples after a change of the plant before a back-off may shrink below its "
            "earlier value"
        ),
    )
    shrink_share: Share = Field(
        0.7,
        description="a back-off shrinks at most to this share of the least distance from its bound "
        "so far",
    )
    largest_back_off: Share = Field(
        0.45,
        description="largest back-off, as a share of the distance of the bounds",
    )
    # how they are searched
    burn_in: Count = Field(300, description="samples of a rollout before it counts")
    coarse_rollout: Count = Field(1800, description="samples of a rollout on the grid")
    fine_rollout: Count = Field(5300, description="samples of a rollout near the best point")
    back_off_levels: tuple[NonNegative, ...] = Field(
        (0.0, 2.0, 3.0, 7.0, 18.0, 50.0),
        description="back-offs of the grid, in standard deviations of the one-step error",
    )
    coarse_factors: tuple[Positive, ...] = Field(
        (0.72, 0.85, 1.18, 1.4),
        description="factors of a back-off in the first sweep about the best point, on coarse "
        "rollouts",
    )
    fine_factors: tuple[Positive, ...] = Field(
        (0.93, 1.07),
        description="factors in the second sweep, on fine rollouts",
    )
    finest_factors: tuple[Positive, ...] = Field(
        (0.97, 1.03),
        description="factors in the third sweep, on fine rollouts",
    )
    # how a cost is predicted and compared
    tail_widening: NonNegative = Field(
        0.1,
        description=(
            "share by which `tail_samples` errors are widened, for missing tails; it "
            "falls with the root of their number"
        ),
    )
    tail_samples: Count = Field(120, description="number of errors to which tail_widening refers")
    recent_samples: Count = Field(
        1440,
        description=(
            "latest samples from which the plant's states and the size of errors are taken"
        ),
    )
    state_ranges: Positive = Field(
        2.0,
        description="ranges of the latest states by which a rollout's mean may differ from theirs",
    )
    least_penalty_share: Positive = Field(
        1e-6,
        description="share of the cost that the penalty of a bound must reach for its back-off to "
        "be searched",
    )
    doubt: NonNegative = Field(
        1.0,
        description="standard deviations within which two predicted costs count as equal",
    )
    persistent_doubt: NonNegative = Field(
        3.0,
        description=(
            "the same where errors persist; θ then moves only to a cost that is lower by as much"
        ),
    )
    plateau: Positive = Field(
        2e-5,
        description="least deviation of such a difference, as a share of the cost",
    )
    cost_thinning: Count = Field(
        10,
        description=(
            "samples of a rollout between two at which the uncertainty of its cost is computed"
        ),
    )


class ModelBased(Algorithm):
    """Operates with θ, fits the empirical model, searches on it, and operates on.

    An update is due when the model's data have doubled, at the latest after `longest_interval` or
    an eighth of them; and as soon as samples cost more than any of the rollout that predicted θ's
    cost. Where the errors since the last update have a mean that the model makes improbable, the
    plant has changed, and the data from there on count. θ moves only where the model, on new noise,
    predicts less for the new one.
    """

    learns_from_estimates = True
    learns_under_signals = True
    under_sensors = ModelFromOutputs
    Configuration = ModelBasedConfiguration
    configuration: ModelBasedConfiguration
    budget: ClassVar[int] = 10_080

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings = self.configuration
        start = self.controller.parameters
        self._problem = Problem.from_scenario(self.scenario)
        self._base = _tuned(self._problem, start)
        self._features = Features(self._problem, settings.smallest_error_size)
        # Of the fitted parameters only those that θ has reach the controller.
        labels = start.blocks.block("p").labels if "p" in start.blocks else ()
        self._carried = self._problem.model.parameter_indices(labels)
        self._rollout = Rollout(self._problem, start, self._features)
        self._data = PlantData(self._features, settings)
        self._signals = KnownSignals(self.scenario, self._problem, settings.recent_samples)
        # A start that is backed off already is not given away.
        self.back_off: Array = self._back_offs(start)
        """Back-offs of θ, of lower then upper bounds, (2n,)."""
        self._due = settings.first_update  # samples at the next update
        self._regime_start = 0  # of the latest update
        self._floor = np.zeros_like(self.back_off)  # back-offs when that regime began
        # Of the mean cost, for each window of the change detection.
        self._limits: Array = np.full(len(settings.change_windows), np.inf)
        self.predicted_cost = float("nan")
        """Predicted mean cost per sample of θ; NaN before the first update."""
        self.model_samples = 0
        """Samples of the model that its rollouts have taken so far."""

    @property
    def changes(self) -> int:
        """Number of detected changes of the plant."""
        return self._data.changes

    @property
    def explores(self) -> bool:
        """Whether the samples explore now."""
        return self._data.count < self.configuration.exploration_samples

    def observe(self, transition: Transition) -> Update | None:
        """Keep a transition; move θ when an update is due."""
        # Every sample is kept; whether one calls for an update is asked once a window.
        data = self._data
        self._keep(transition)
        model = data.model
        alarmed = False
        if model is not None and data.since_fit % self.configuration.change_windows[0] == 0:
            alarmed = self.alarmed(model)
        if alarmed or data.count >= self._due:
            return self._update(alarmed)
        return None

    def watch(self, transition: Transition) -> None:
        """Keep a transition; θ stays."""
        self._keep(transition)

    def _keep(self, transition: Transition) -> None:
        """Keep a transition, and what was known of the signals at its sample."""
        self._signals.add(transition)
        self._data.add(transition, self._signals.inputs_of(transition.known))

    def retreat(self) -> None:
        """Take the back-offs of the θ to which the loop has gone back; nothing is predicted."""
        self.back_off = self._back_offs(self.controller.parameters)
        self._floor = np.zeros_like(self.back_off)
        self._limits[:] = np.inf
        self.predicted_cost = np.nan

    def _back_offs(self, theta: Parameters) -> Array:
        """Back-offs of θ from the true bounds, lower then upper ones, (2n,)."""
        lower = theta["x_l"] - self._base["x_l"]
        upper = self._base["x_u"] - theta["x_u"]
        distances = np.concatenate([lower, upper])
        back_offs: Array = np.maximum(distances, 0.0)
        return back_offs

    def alarmed(self, model: EmpiricalModel) -> bool:
        """Whether samples cost more than was predicted or, on new data, the plant is another."""
        settings = self.configuration
        if len(model.residuals) < settings.least_samples:
            return False
        predictions = self._data.predictions()
        expected = ExpectedCosts(self._problem, model, settings)
        n_predicted = len(predictions.outputs)
        numbers = self._data.latest_numbers(n_predicted)
        inputs, _ = self._data.latest(n_predicted)
        signals = self._signals_of(inputs)
        # A sample's penalty is here that of the state to which it leads.
        bounds = self._signals.bounds([number + 1 for number in numbers])
        costs, _ = expected(predictions.outputs, predictions.h, bounds)
        # What prices alone change no θ can help.
        costs = costs - self._signals.price_costs(signals)
        # Costs by the model's expectation: realised penalties are too rare.
        too_costly = []
        if len(costs) > settings.settling_samples:
            for window, limit in zip(settings.change_windows, self._limits, strict=True):
                latest = costs[-window:]
                if window <= len(costs) and latest.mean() > limit:
                    too_costly.append(window)
        changed = self._data.changed(predictions, too_costly)
        return changed or bool(too_costly)

    def _signals_of(self, inputs: Array) -> Array:
        """Inputs of the model that signals give, from (s, a, v), (M, n_v)."""
        n_before = self._features.n_inputs - self._features.n_signals
        return inputs[:, n_before:]

    def _update(self, alarmed: bool) -> Update:
        """Fit the model, search on it, and move θ where the model predicts less for the new one."""
        settings = self.configuration
        data = self._data
        present = self.controller.parameters
        blocks = present.blocks
        soon = data.count + settings.change_windows[-2]
        model = self._fitted()
        if model is None:
            # A plant that has run away leaves no model: ask again soon.
            self._due = soon
            stays = update_without_fit(blocks, present.theta, present.theta, refused=True)
            return stays._replace(lost=True)
        self._begin_regime()
        # Day by day an optimum moves little: then the search begins at the present back-offs.
        # Without limits the present cost was never predicted.
        known = bool(np.isfinite(self._limits).all())
        settled = data.age > settings.longest_interval and not alarmed and known
        levels = () if settled else settings.back_off_levels
        # Data double between updates, then grow by a share.
        longest = max(settings.longest_interval, data.age // settings.refit_growth)
        interval = min(data.age, longest)
        self._due = data.count + max(interval, settings.first_update)

        inputs, _ = data.present
        latest, _ = data.latest(settings.recent_samples)
        latest_numbers = data.latest_numbers(settings.recent_samples)
        recent = inputs[-settings.recent_samples :]
        base, gained = self.corrected(present, model, recent)
        # What c_f and the parameters correct, back-offs need not hold any more.
        shift = np.concatenate([gained, -gained])
        kept = np.maximum(self.back_off + shift, 0.0)
        bounds = self._signals.bounds(data.latest_numbers(len(inputs)))
        least = self.least_back_offs(kept, inputs, bounds)
        search = BackOffOnModel(
            self._problem,
            self._rollout,
            base,
            model,
            latest,
            settings,
            self.rng,
            self._signals,
            latest_numbers,
        )
        best = search.best(kept, least, levels)

        # The comparison that decides meets noise that no search has seen.
        new = search.theta(best)
        search.draw(settings.fine_rollout)
        cost_of_new, cost_of_present = search.predicted_costs([new, present.theta])
        least_gain = search.doubt if model.persistence.any() else 0.0
        better = search.excess(cost_of_new, cost_of_present) <= -least_gain
        prediction = cost_of_new if better else cost_of_present
        self._limits = prediction.limits
        self.predicted_cost = prediction.cost + prediction.price_cost
        if better:
            self.back_off = best
            self.controller.theta = new
        lost = not np.isfinite(self._limits).all()
        if lost:
            # Nothing is known of any cost: look again soon.
            self._due = min(self._due, soon)
        self.model_samples += search.n_samples
        end = self.controller.theta
        update = update_without_fit(blocks, present.theta, end, refused=not better)
        return update._replace(lost=lost)

    def _begin_regime(self) -> None:
        """After a change of the plant: keep the back-offs of before, as a floor."""
        began = self._data.regime_start
        if began == self._regime_start:
            return
        # A regime that was young itself had a floor of before.
        young = began - self._regime_start < self.configuration.steady_samples
        if young and self._regime_start > 0:
            self._floor = np.minimum(self._floor, self.back_off)
        else:
            self._floor = self.back_off
        self._regime_start = began

    def _fitted(self) -> EmpiricalModel | None:
        """The model of the present plant; None where its data or predictions are not finite."""
        latest, outputs = self._data.latest(self.configuration.recent_samples)
        if not np.isfinite(outputs).all():
            return None
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                model = self._data.fit()
                predicted, h, _ = model.predict(latest)
        except np.linalg.LinAlgError:
            return None
        for values in (predicted, h, model.noise):
            if not np.isfinite(values).all():
                return None
        return model

    def least_back_offs(
        self,
        present: Array,
        inputs: Array,
        bounds: tuple[Array, Array] | None = None,
    ) -> Array:
        """Least back-offs that the data allow.

        A present one shrinks little beyond the state that came closest to its bound: what lies
        behind it the model only extrapolates. Of few samples none shrinks, nor while they explore,
        which no rollout does. A plant that has changed may go on to: until it has been the same for
        `steady_samples` none shrinks below what it was before.

        Args:
            present: back-offs, (2n,).
            inputs: (s, a, v) of the present regime, (M, n+m+n_v).
            bounds: true ones of the states at these samples, (M, n) each; None: they do not move.
        """
        settings = self.configuration
        problem = self._problem
        if self.explores or len(inputs) < settings.least_samples:
            return present
        floor = np.zeros_like(present)
        if self._regime_start > 0 and len(inputs) < settings.steady_samples:
            floor = np.minimum(self._floor, present)
        # What the plant has shown: its distances from the true bounds.
        states = inputs[:, : problem.n_states]
        lower, upper = bounds or (problem.state_lower, problem.state_upper)
        above = states - lower
        below = upper - states
        distances = np.concatenate([above, below], axis=1)
        shown = settings.shrink_share * distances.min(axis=0)
        least: Array = np.clip(shown, floor, present)
        return least

    def corrected(
        self,
        present: Parameters,
        model: EmpiricalModel,
        inputs: Array,
    ) -> tuple[Parameters, Array]:
        """θ before its back-offs, with the fitted model parameters and offset.

        c_f is the mean prediction error with them. Of few samples the present ones stay.

        Args:
            present: θ.
            model: of the present regime.
            inputs: (s, a) of it, (M, n+m).

        Returns:
            The new θ, and what the controller's predictions of s₊ gain by it, (n,).
        """
        kept = {}
        for name in ("p", "c_f"):
            if name in present.blocks:
                kept[name] = present[name]
        if len(inputs) < self.configuration.least_samples:
            return self._base.replace(kept), np.zeros_like(present["c_f"])
        # Errors of the nominal parameters in the controller's model, before and after.
        before = np.zeros(self._features.n_parameters)
        after = np.zeros(self._features.n_parameters)
        if "p" in kept:
            carried = self._carried
            nominal = self._problem.model.nominal_parameters[carried]
            fitted = model.mean[carried]
            before[carried] = kept["p"] / nominal - 1
            after[carried] = fitted
            kept["p"] = nominal * (1 + fitted)
        # Offset-free: what the controller's model still lacks on average.
        kept["c_f"] = model.nominal_prediction_error(inputs, after)
        error_before = model.nominal_prediction_error(inputs, before)
        return self._base.replace(kept), error_before - present["c_f"]

    def state_dict(self) -> State:
        """Back-offs, schedule, limits and data."""
        return {
            "back_off": self.back_off,
            "due": self._due,
            "model_samples": self.model_samples,
            "limits": self._limits,
            "predicted_cost": self.predicted_cost,
            "floor": self._floor,
            "regime_start": self._regime_start,
            **prefixed("data", self._data.state_dict()),
            **prefixed("signals", self._signals.state_dict()),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self.back_off = state["back_off"]
        self._due = state["due"]
        self.model_samples = state["model_samples"]
        self._limits = state["limits"]
        self.predicted_cost = state["predicted_cost"]
        self._floor = state["floor"]
        self._regime_start = state["regime_start"]
        self._data.load_state_dict(part_of(state, "data"))
        self._signals.load_state_dict(part_of(state, "signals"))


class PredictedCost(NamedTuple):
    """Prediction of a model for a θ.

    Attributes:
        cost: mean per sample; infinite where the rollout is lost.
        derivative: of the mean stage cost by the model's coefficients, (q,).
        limits: of the mean cost of so many samples as each window of the change detection has.
        price_cost: what prices alone add to the mean cost, at the reference, which is in neither
            cost nor limits.
    """

    cost: float
    derivative: Array
    limits: Array
    price_cost: float


class ExpectedCosts:
    """Costs of samples that a model predicts, the penalty by its expectation over all residuals."""

    def __init__(
        self,
        problem: Problem,
        model: EmpiricalModel,
        settings: ModelBasedConfiguration,
    ) -> None:
        self.penalty = problem.penalty
        # Penalties are of states; the last output is the cost.
        errors = model.residuals[:, : problem.n_states]
        self._errors = SortedErrors(errors)
        # Few errors have no tails: those that they have are widened.
        fewness = (settings.tail_samples / len(errors)) ** 0.5
        self._widened = 1 + settings.tail_widening * fewness

    def __call__(
        self,
        predicted: Array,
        h: Array,
        bounds: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:
        """Expected costs.

        Args:
            predicted: (s₊, ℓ), (M, K).
            h: sizes of the errors, (M, K).
            bounds: of the states s₊ where they move, (M, n) each; None: the scenario's.

        Returns:
            Costs (M,), and the penalty of each bound in them, (2n, M).
        """
        states = predicted[:, :-1]
        stage_costs = predicted[:, -1]
        sizes = self._widened * h
        due = expected_penalties(self.penalty, states, self._errors, sizes, bounds)
        # From (state, bound) to lower bounds and then upper ones, as back-offs are.
        by_bound = due.swapaxes(0, 1)
        penalties = by_bound.reshape(-1, len(predicted))
        return stage_costs + penalties.sum(axis=0), penalties


def one_step_deviation(problem: Problem, model: EmpiricalModel, h: Array) -> Array:
    """Standard deviation of a state's one-step error, at least a millionth of its own unit, (n,).

    Args:
        problem: has the units.
        model: has the errors.
        h: their sizes at some samples, (M, K).
    """
    n = problem.n_states
    size = h.mean(axis=0)
    deviation: Array = model.error_deviation[:n] * size[:n]
    return np.maximum(deviation, 1e-6 * problem.units.state)


class BackOffOnModel:
    """Searches back-offs δ (2n,) of the lower, then the upper state bounds on an empirical model.

    Rollouts begin at the last of the visited states. One fails if it costs more on average than the
    most expensive of the visited samples, or if its mean state is far from theirs: the plant has
    not been there. All θ meet the same noise until the
    next `draw`. δ are multiples of a twentieth of the error's order of magnitude, so that no last
    digit decides.

    Args:
        problem: bounds and penalty.
        rollout: of the problem's controller.
        base: θ before its back-offs.
        model: plays the plant.
        visited: the latest inputs (s, a), (M, n+m), oldest first.
        settings: of the search.
        rng: draws the noise.
        signals: of the scenario.
        numbers: of the visited samples, (M,).

    Attributes:
        n_samples: of rollouts so far.
        unit: of the back-offs, the standard deviation of the one-step error, (2n,).
        doubt: deviations of a difference of costs within which the model cannot tell.
    """

    def __init__(
        self,
        problem: Problem,
        rollout: Rollout,
        base: Parameters,
        model: EmpiricalModel,
        visited: Array,
        settings: ModelBasedConfiguration,
        rng: np.random.Generator,
        signals: KnownSignals,
        numbers: Sequence[int],
    ) -> None:
        n = problem.n_states
        self._settings = settings
        self._signals = signals
        self._problem = problem
        self._rollout = rollout
        self._base = base
        self._model = model
        self._rng = rng
        self._costs = ExpectedCosts(problem, model, settings)
        predicted, h, _ = model.predict(visited)
        # What no sample of the plant has cost, a rollout does not know.
        bounds = signals.bounds([number + 1 for number in numbers])
        visited_costs, _ = self._costs(predicted, h, bounds)
        n_loop = n + problem.n_actions
        visited_costs = visited_costs - signals.price_costs(visited[:, n_loop:])
        self._largest_cost = visited_costs.max()
        # What one set-point has cost is no measure of a period of several.
        period = signals.period or settings.recent_samples
        if signals.move_targets and len(visited) < min(period, settings.recent_samples):
            self._largest_cost = np.inf
        states = visited[:, :n]
        self._start = states[-1]
        self._centre = states.mean(axis=0)
        self._reach = settings.state_ranges * np.ptp(states, axis=0)
        if len(visited) < settings.recent_samples:
            self._reach[:] = np.inf  # the plant has not settled yet
        self.unit = np.tile(one_step_deviation(problem, model, h), 2)
        distance = problem.state_upper - problem.state_lower
        self._most = np.tile(settings.largest_back_off * distance, 2)
        self.doubt = settings.doubt
        if model.persistence.any():
            # Student's: few independent errors hardly know their own size.
            n_independent = model.effective_number(len(model.residuals))
            tail = ndtr(settings.persistent_doubt)
            self.doubt = float(stdtrit(n_independent, tail))
        self._penalty_share = np.zeros(2 * n)  # largest of each bound so far
        self.n_samples = 0
        self.draw(settings.coarse_rollout)

    def draw(self, steps: int) -> None:
        """Draw new noise for rollouts of so many samples."""
        settings = self._settings
        n_residuals = len(self._model.residuals)
        steps = self._signals.whole_periods(steps, settings.burn_in, settings.memory)
        self._met = self._signals.coming(steps)
        self._picks = self._rng.integers(n_residuals, size=steps, dtype=np.int32)
        self._known: dict[bytes, PredictedCost] = {}  # on this noise, by θ

    def theta(self, delta: Array) -> Array:
        """θ with its bounds backed off by δ."""
        n = self._problem.n_states
        lower = self._base["x_l"] + delta[:n]
        upper = self._base["x_u"] - delta[n:]
        return self._base.replace({"x_l": lower, "x_u": upper}).theta

    def predicted_costs(self, thetas: Sequence[Array]) -> list[PredictedCost]:
        """Predicted cost of each θ, (n_θ,) each; infinite where the rollout failed."""
        keys = [theta.tobytes() for theta in thetas]
        new = {}
        for key, theta in zip(keys, thetas, strict=True):
            if key not in self._known:
                new[key] = theta
        rollouts = self._rollout(
            list(new.values()),
            self._start,
            self._model,
            self._picks,
            self._met,
        )
        for key, samples in zip(new, rollouts, strict=True):
            self._known[key] = self._predicted_cost(samples)
        return [self._known[key] for key in keys]

    def _predicted_cost(self, samples: RolloutSamples) -> PredictedCost:
        """Prediction of a θ from the samples of a rollout."""
        settings = self._settings
        self.n_samples += len(samples.inputs)
        # A rollout counts once it has settled.
        inputs = samples.inputs[settings.burn_in :]
        predicted = samples.predicted[settings.burn_in :]
        h = samples.h[settings.burn_in :]
        complete = len(inputs) >= len(self._picks) - settings.burn_in
        if not complete or not np.isfinite(predicted).all():
            return self._lost
        bounds = (
            self._met.lower[settings.burn_in :],
            self._met.upper[settings.burn_in :],
        )
        price_costs = self._met.costs[settings.burn_in :]
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that runs away
            costs, penalties = self._costs(predicted, h, bounds)
        # Without what prices alone change: so hours are alike.
        costs = costs - price_costs
        cost = float(costs.mean())
        if not np.isfinite(cost):
            return self._lost
        # A bound shows in lost rollouts too.
        stage_cost = float(predicted[:, -1].mean())
        size = max(abs(stage_cost), np.finfo(np.float64).eps)
        penalty_share = penalties.mean(axis=1) / size
        self._penalty_share = np.maximum(self._penalty_share, penalty_share)
        n = self._problem.n_states
        mean_state = inputs[:, :n].mean(axis=0)
        away = np.abs(mean_state - self._centre)
        if cost > self._largest_cost or (away > self._reach).any():
            return self._lost
        some_inputs = inputs[:: settings.cost_thinning]
        derivative = self._model.cost_derivative(some_inputs)
        limits = self._limits_of(costs)
        return PredictedCost(cost, derivative, limits, float(price_costs.mean()))

    def _limits_of(self, costs: Array) -> Array:
        """Cost above which a prediction (M,) is called broken, for each window."""
        settings = self._settings
        cost = float(costs.mean())
        worst = []
        for window in settings.change_windows:
            means = _moving_mean(costs, window)
            worst.append(means.max(initial=cost))
        excess = np.array(worst) - cost
        limits: Array = cost + settings.cost_excess * excess
        return limits

    @property
    def _lost(self) -> PredictedCost:
        """Prediction of a rollout that failed."""
        derivative = np.zeros_like(self._model.mean)
        limits = np.full(len(self._settings.change_windows), np.inf)
        return PredictedCost(np.inf, derivative, limits, 0.0)

    def excess(self, one: PredictedCost, other: PredictedCost) -> float:
        """Cost of one above another's, in deviations of what the model knows of the difference."""
        if not np.isfinite(one.cost):
            return np.inf
        # Both costs err alike where they depend alike on the coefficients.
        derivative = one.derivative - other.derivative
        variance = float(derivative @ self._model.covariance @ derivative)
        least = self._settings.plateau * abs(one.cost)
        deviation = max(variance**0.5, least)
        difference = one.cost - other.cost
        return float(difference / deviation)

    def best(
        self,
        delta: Array,
        least: Array,
        levels: Sequence[float],
    ) -> Array:
        """The smallest δ whose cost the model cannot tell from the least one.

        First a grid over up to two active bounds at once, those whose penalty shows anywhere, and
        over further ones one by one. Then sweeps over each about the best point, on longer
        rollouts. Bounds whose penalty shows nowhere have a reserve back-off.

        Args:
            delta: present δ, (2n,).
            least: least δ, (2n,).
            levels: of the grid, in standard deviations of the one-step error; without any the
                search begins at δ alone.
        """
        settings = self._settings
        # Levels of the grid, none below what the data allow.
        grids = []
        for i, unit in enumerate(self.unit):
            wanted = [max(level * unit, least[i]) for level in levels]
            grids.append(self._rounded(i, wanted))
        active: list[int] = []
        points = [delta, least]
        while True:
            delta = self._cheapest(points)
            newly_active = self._next_active(active)
            if newly_active is None:
                break
            active.append(newly_active)
            # Two bounds at once: their back-offs depend on each other.
            together = active if len(active) <= 2 else active[-1:]
            points = [delta]
            levels_together = [grids[i] for i in together]
            for corner in product(*levels_together):
                points.append(_with(delta, together, corner))

        sweeps = [
            (settings.coarse_rollout, settings.coarse_factors),
            (settings.fine_rollout, settings.fine_factors),
            (settings.fine_rollout, settings.finest_factors),
        ]
        for steps, factors in sweeps:
            # Longer rollouts need new noise; all θ meet the same again.
            if steps > len(self._picks):
                self.draw(steps)
            for i in active:
                delta = self._swept(delta, i, least[i], factors)
        for i in range(len(delta)):
            if i not in active:
                delta = self._with_reserve(delta, i)
        return delta

    def _next_active(self, active: Sequence[int]) -> int | None:
        """The bound of largest penalty that is not searched yet and shows; None without one."""
        for i in np.argsort(-self._penalty_share).tolist():
            shows = self._penalty_share[i] > self._settings.least_penalty_share
            if shows and i not in active:
                return int(i)
        return None

    def _swept(
        self,
        delta: Array,
        i: int,
        least: float,
        factors: Sequence[float],
    ) -> Array:
        """The cheapest of δ and of those with factors of the back-off of a bound."""
        wanted = [self.unit[i]]
        if delta[i]:
            wanted = [delta[i] * factor for factor in factors]
        allowed = [max(value, least) for value in wanted]
        points = [delta]
        for value in self._rounded(i, allowed):
            points.append(_with(delta, [i], [value]))
        return self._cheapest(points)

    def _with_reserve(self, delta: Array, i: int) -> Array:
        """δ with as much of the reserve back-off of a bound that is not active as costs nothing."""
        # Half of it, then all: the largest that costs nothing.
        reserve = self._settings.reserve_back_off * self.unit[i]
        wanted = [0.5 * reserve, reserve]
        points = [delta]
        for value in self._rounded(i, wanted):
            if value > delta[i]:
                points.append(_with(delta, [i], [value]))
        thetas = [self.theta(point) for point in points]
        costs = self.predicted_costs(thetas)
        without = costs[0]
        free = delta
        for point, cost in zip(points, costs, strict=True):
            if self.excess(cost, without) <= self.doubt:
                free = point
        return free

    def _rounded(self, i: int, values: Sequence[float]) -> list[float]:
        """Back-offs of a bound as multiples of its step, within its room, ascending."""
        # A twentieth of the error's order of magnitude.
        magnitude = np.floor(np.log10(self.unit[i]))
        step = 10.0**magnitude / 20
        rounded = set()
        for value in values:
            multiple = round(value / step) * step
            within = min(multiple, self._most[i])
            rounded.add(float(within))
        return sorted(rounded)

    def _cheapest(self, points: Sequence[Array]) -> Array:
        """The smallest of the points whose cost the model cannot tell from the least one."""
        thetas = [self.theta(point) for point in points]
        costs = self.predicted_costs(thetas)
        least = min(costs, key=lambda predicted: predicted.cost)
        # Of what the model cannot tell apart, the smallest back-off.
        close = []
        for point, cost in zip(points, costs, strict=True):
            if self.excess(cost, least) <= self.doubt:
                close.append(point)

        def size(point: Array) -> float:
            in_units = point / self.unit
            return float(in_units.sum())

        return min(close or points[:1], key=size)


def _moving_mean(costs: Array, window: int) -> Array:
    """Means of so many costs in a row."""
    with_zero = np.concatenate([[0.0], costs])
    total: Array = with_zero.cumsum()
    sums = total[window:] - total[:-window]
    return sums / window


def _with(
    delta: Array,
    bounds: Sequence[int],
    values: Sequence[float],
) -> Array:
    """δ with the values of some bounds changed."""
    changed = delta.copy()
    changed[list(bounds)] = values
    return changed


def _tuned(problem: Problem, start: Parameters) -> Parameters:
    """θ with the cost tuned on the nominal model and the true bounds, all else the start's."""
    try:
        tuned = tune(problem, start.blocks).parameters
    except TuningError:
        return start
    kept = {}
    for name in ("c_lambda", "c_f", "w_sigma", "W_sigma", "p"):
        if name in start.blocks:
            kept[name] = start[name]
    return tuned.replace(kept)
