"""`model-based` under sensors: filter, model and back-offs from readings that have gaps.

At each update the variances of the estimator's noises are fitted to the plant's innovations
(`learning.innovations`). The uncertain parameters are the filter's estimates at these variances.
Both make a plant: the controller's model at these parameters, with disturbances of these variances,
behind the same sensors. On that plant, behind the same filter, back-offs are searched. A sample of
it costs its stage cost at the estimate and the expectation of the next state's penalty.

Where θ has a block `margin`, a part κ of a back-off follows the estimate's deviation σ. The search
moves κ at the same mean back-off δ, whose constant part is δ − κσ̄ at the mean σ̄ of a rollout.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from controllers.errors import ModelWarning, QpError
from controllers.estimator import ExtendedKalmanFilter, OutputFeedback
from controllers.factories import nmpc
from controllers.functions import StackedFunction, define
from controllers.model import discretise
from controllers.problem import Problem
from controllers.theta import Parameters, ThetaBlocks
from cosim.core.errors import warn
from cosim.core.protocols import Array, Vector
from cosim.core.scenario import Scenario
from cosim.core.sensors import Sensors
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State
from learning.errors import ConfigurationError
from learning.gaussian_penalty import expected_penalties_with_errors
from learning.innovations import Stretch, fit_noise
from learning.step import update_without_fit

MEND_OF_BIAS = (
    "name the parameter that may be wrong in the model's `uncertain`, or mend the model "
    "(`cosim fmu check FMU --model MODEL`)"
)
"""What is done about readings that lie to one side of the model's."""


class ModelFromOutputs(Algorithm):
    """Operates with θ, fits filter and model to the readings, searches on them, and operates on.

    θ moves where the fitted plant costs less with the new one. Its settings are those of
    `model-based`.
    """

    learns_from_estimates = True
    budget: ClassVar[int] = 10_080
    configuration: Any
    explores = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        start = self.controller.parameters
        settings = self.configuration
        if "noise" not in start.blocks:
            raise ConfigurationError(
                f"model-based under sensors moves the estimator's variances, and scenario "
                f"'{self.scenario.name}' has no estimator of kind 'ekf': leave out estimator.kind "
                "and noise=false"
            )
        self.filter = ExtendedKalmanFilter.from_scenario(self.scenario, differentiates=True)
        self.filter.compile()
        self.prior_mean = self.filter.noise
        self.plant = FittedPlant(self.scenario, start, settings.normal_errors)
        problem = Problem.from_scenario(self.scenario)
        # Back-offs are searched anew: they are counted from the true bounds.
        true_bounds = {"x_l": problem.state_lower, "x_u": problem.state_upper}
        self._base = start.replace(true_bounds)
        self._distance = problem.state_upper - problem.state_lower
        self._n_bounds = 2 * problem.n_states
        self._reserve = self._back_offs(start, np.zeros(problem.n_states))[: self._n_bounds]

        # A ring of (y, a).
        sensors = self.scenario.sensors or ()
        self._delays = np.array([sensor.delay for sensor in sensors])
        n_columns = self._delays.size + problem.n_actions
        self._rows: Array = np.zeros((settings.output_samples, n_columns))
        self._n_rows = 0  # since the last sample that is missing

        # Innovations of the sensors of each state, over their expected deviations.
        names = [quantity.name for quantity in problem.model.states]
        self._sensors_of_states = {}
        for i, sensor in enumerate(sensors):
            if sensor.variable in names:
                state = names.index(sensor.variable)
                self._sensors_of_states[state] = i
        self.errors: list[Array] = [np.empty(0) for _ in names]
        self._n_seen = 0  # samples whose innovations are among them
        self._count = 0
        self._due = max(settings.first_update, settings.least_samples)
        self.predicted_cost = float("nan")
        """Mean cost per sample of the fitted plant at θ; NaN before the first update."""

    def observe(self, transition: Transition) -> Update | None:
        """Keep a sample's readings; move θ when an update is due."""
        self.watch(transition)
        if self._count < self._due:
            return None
        settings = self.configuration
        # While data are few an update waits until they have doubled.
        interval = min(self._count, settings.longest_interval)
        self._due = self._count + interval
        if self._n_rows < settings.least_samples:
            return None
        return self._update()

    def watch(self, transition: Transition) -> None:
        """Keep a sample's readings; θ stays."""
        assert transition.y is not None
        row = np.concatenate([transition.y, transition.a])
        oldest = self._n_rows % len(self._rows)
        self._rows[oldest] = row
        self._n_rows += 1
        self._count += 1

    def failed(self, cost: float) -> None:
        """Begin the data anew: a filter cannot go on over a sample that is missing."""
        self._n_rows = 0
        self._count += 1

    def retreat(self) -> None:
        """Go on from the θ to which the loop has gone back; nothing is predicted."""
        self.predicted_cost = np.nan

    @property
    def _data(self) -> Stretch:
        """The latest samples."""
        size = len(self._rows)
        count = min(self._n_rows, size)
        # The ring as time has it.
        samples = np.arange(self._n_rows - count, self._n_rows)
        rows = self._rows[samples % size]
        n_sensors = self._delays.size
        readings, actions = np.split(rows, [n_sensors], axis=1)
        # What was read before the data begin says nothing of their states.
        for i, delay in enumerate(self._delays):
            readings[:delay, i] = np.nan
        return Stretch(readings, actions)

    def _update(self) -> Update:
        """Fit filter and model, search back-offs, and set θ where that costs less."""
        present = self.controller.parameters
        noise, innovations = self.fit_filter([self._data])
        biased = self.biased_sensors(innovations)
        if biased:
            # The plant that is fitted has no such error: what it predicts is of another plant.
            warn(
                f"scenario '{self.scenario.name}': the readings of {', '.join(biased)} are off the "
                f"model's for good, which no noise explains, and θ stays: {MEND_OF_BIAS}",
                ModelWarning,
            )
            self.predicted_cost = np.nan
            theta = present.theta
            update = update_without_fit(present.blocks, theta, theta, refused=True)
            return update._replace(lost=True)
        self._keep_errors(innovations)
        # Of few samples no back-off shrinks.
        may_shrink = self._n_rows >= self.configuration.shrink_samples
        best, cost = self.search(noise, may_shrink=may_shrink)
        self.predicted_cost = cost.mean
        # Where the best back-offs run away, too, the fitted plant says nothing of any θ.
        lost = not np.isfinite(cost.mean)
        if not lost:
            self.controller.theta = best.theta
        end = self.controller.theta
        update = update_without_fit(present.blocks, present.theta, end, refused=lost)
        return update._replace(lost=lost)

    def fit_filter(self, stretches: Sequence[Stretch]) -> tuple[Vector, Array]:
        """Fit the filter's variances, from θ's on.

        Args:
            stretches: the data.

        Returns:
            η, (q,), and the innovations over their expected deviations, (M, n_y).
        """
        settings = self.configuration
        self.filter.noise = self.controller.parameters["noise"]
        return fit_noise(
            self.filter,
            stretches,
            self.prior_mean,
            settings.noise_prior,
            settings.fit_noise_rounds,
        )

    def search(self, noise: Vector, *, may_shrink: bool) -> tuple[Parameters, SimulatedCost]:
        """θ of least cost on the plant that the filter and the errors make, and that cost.

        Args:
            noise: η of the filter, (q,).
            may_shrink: whether a back-off may be less than it is.
        """
        settings = self.configuration
        present = self.controller.parameters
        parameters = self.filter.parameters
        base = self._base.replace({"noise": noise})
        base = _with_parameters(base, parameters)
        seed = int(self.rng.integers(2**63))
        self.plant.fit(self.filter, parameters, self.errors, seed)

        # The search begins at the present back-offs.
        mean_deviation = self._mean_deviation(base, present)
        start = self._back_offs(present, mean_deviation)
        search = BackOffsBehindFilter(
            self.plant, base, self._distance, self._reserve, mean_deviation, settings
        )
        best = search.best(start, may_shrink)
        return search.theta(best), search.cost(best)

    def _mean_deviation(self, base: Parameters, present: Parameters) -> Vector:
        """What the filter is off in each state, in a rollout at the present bounds, (n,)."""
        if "margin" not in present.blocks:
            return np.zeros(self._n_bounds // 2)
        bounds = {name: present[name] for name in ("x_l", "x_u", "margin")}
        settings = self.configuration
        cost = self.plant.run(
            base.replace(bounds),
            settings.simulated_samples,
            settings.burn_in,
        )
        return cost.deviation

    def _back_offs(self, theta: Parameters, mean_deviation: Vector) -> Vector:
        """δ of the lower, then of the upper bounds, (2n,); behind them κ, where θ has a `margin`.

        Args:
            theta: θ.
            mean_deviation: σ̄ of the estimate, (n,).
        """
        lower = theta["x_l"] - self._base["x_l"]
        upper = self._base["x_u"] - theta["x_u"]
        constant = np.concatenate([lower, upper])
        # A bound of θ beyond the true one has none.
        if "margin" not in theta.blocks:
            back_offs: Vector = np.maximum(constant, 0.0)
            return back_offs
        factors = theta["margin"]
        mean = constant + factors * np.tile(mean_deviation, 2)
        return np.concatenate([np.maximum(mean, 0.0), factors])

    def biased_sensors(self, innovations: Array) -> list[str]:
        """Names of the sensors whose readings lie to one side of what the filter expects.

        Args:
            innovations: over their expected deviations, (M, n_y), NaN where there is no reading.
        """
        names = []
        for i, sensor in enumerate(self.scenario.sensors or ()):
            of_sensor = innovations[:, i]
            arrived = of_sensor[~np.isnan(of_sensor)]
            # Of few readings the mean is chance.
            if len(arrived) < self.configuration.least_biased_readings:
                continue
            if abs(arrived.mean()) > self.configuration.largest_bias:
                names.append(sensor.variable)
        return names

    def _keep_errors(self, innovations: Array) -> None:
        """Keep those of the samples since the last update, as this fit has them."""
        n_new = min(self._count - self._n_seen, len(innovations))
        new = innovations[-n_new:]
        self._n_seen = self._count
        capacity = self.configuration.output_samples
        for state, arrived in enumerate(self.errors_of_states(new)):
            kept = np.concatenate([self.errors[state], arrived])
            self.errors[state] = kept[-capacity:]

    def errors_of_states(self, innovations: Array) -> list[Array]:
        """Innovations (M, n_y) of each state's own sensor, (M_i,); none of a state without one."""
        errors = []
        for state in range(len(self.errors)):
            arrived = np.empty(0)
            if state in self._sensors_of_states:
                of_sensor = innovations[:, self._sensors_of_states[state]]
                # Where nothing came there is no innovation.
                arrived = of_sensor[~np.isnan(of_sensor)]
            errors.append(arrived)
        return errors

    def state_dict(self) -> State:
        """Readings, schedule and prediction; the filter's variances are θ's."""
        state: State = {
            "rows": self._rows,
            "n_rows": self._n_rows,
            "count": self._count,
            "due": self._due,
            "predicted_cost": self.predicted_cost,
            "n_seen": self._n_seen,
        }
        for i, errors in enumerate(self.errors):
            state[f"errors{i}"] = errors
        return state

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._rows = state["rows"]
        self._n_rows = state["n_rows"]
        self._count = state["count"]
        self._due = state["due"]
        self.predicted_cost = state["predicted_cost"]
        self._n_seen = state["n_seen"]
        n_states = len(self.errors)
        self.errors = [state[f"errors{i}"] for i in range(n_states)]


class FilteredRollout(NamedTuple):
    """T samples of a loop behind the filter.

    Attributes:
        means: of the states, predicted before a sample's readings are taken up, (T, n).
        variances: of the errors of these, (T, n).
        costs: stage costs at the estimate, (T,).
        penalties: expected ones of the lower, then of the upper bounds, (2n, T).
    """

    means: Array
    variances: Array
    costs: Array
    penalties: Array


class SimulatedCost(NamedTuple):
    """Cost of a rollout behind the filter.

    Attributes:
        mean: per sample; infinite where a QP failed or the loop ran away.
        penalties: expected one of each bound in it, (2n,).
        deviation: of the predicted states' errors, (n,).
    """

    mean: float
    penalties: Vector
    deviation: Vector


def _cost_of_a_failure(n: int) -> SimulatedCost:
    """The cost of a rollout that was not finished, of a model of n states."""
    return SimulatedCost(
        mean=np.inf,
        penalties=np.full(2 * n, np.inf),
        deviation=np.zeros(n),
    )


class FittedPlant:
    """The controller's model as a plant behind the scenario's sensors, and its filter and NMPC.

    Args:
        scenario: model, sensors and penalty.
        parameters: θ, for its blocks.
        n_normal: weight of a normal law beside the errors that were seen; it may be set anew.
    """

    def __init__(
        self,
        scenario: Scenario,
        parameters: Parameters,
        n_normal: float,
    ) -> None:
        problem = Problem.from_scenario(scenario)
        model = problem.model
        x, u, d, p = model.symbols()
        simulate = discretise(model, problem.sampling_time, problem.substeps)
        next_x = simulate(x, u, d, p)
        cost = ca.SX(model.economic_cost(x, u, d, p))
        arguments = {"s": x, "u": u, "d": d, "p": p}
        results = {"x": next_x, "l": cost}
        definition = define("fitted", arguments, results)
        self._step = StackedFunction(definition)
        self._scenario = scenario
        self.n_normal = n_normal
        self._model = model
        # The filter's variances are set once for all rollouts: θ need not carry them.
        self._controller = nmpc(scenario, _without_noise(parameters))
        self._controller.compile()
        self._filter = ExtendedKalmanFilter.from_scenario(scenario)
        self._filter.compile()
        self._law = OutputFeedback(self._filter, self._controller)
        self._state: dict[str, Vector] = {}

    @cached_property
    def _own_filter(self) -> ExtendedKalmanFilter:
        """A filter whose variances are θ's own, whatever the plant's are."""
        estimator = ExtendedKalmanFilter.from_scenario(self._scenario)
        estimator.compile()
        return estimator

    @cached_property
    def _own_law(self) -> OutputFeedback:
        """The controller behind that filter."""
        return OutputFeedback(self._own_filter, self._controller)

    def fit(
        self,
        estimator: ExtendedKalmanFilter,
        parameters: dict[str, float],
        errors: Sequence[Array],
        seed: int,
    ) -> None:
        """Take variances, parameters and the present state of a filter that fits the data.

        Args:
            estimator: the filter.
            parameters: the uncertain ones, by name.
            errors: of each state that were seen, over their expected deviations, (M_i,).
            seed: of the noise, which all rollouts meet until the next fit.
        """
        model = self._model
        self._errors = errors
        self._filter.noise = estimator.noise
        # A rollout begins where the filter is at the last sample.
        state = estimator.state_dict()
        self._state = {name: state[name] for name in ("states", "covariance")}
        self._p = model.nominal_parameters
        for name, value in parameters.items():
            index = model.parameter_indices((name,))
            self._p[index] = value

        # The disturbances' variances come first in `noise`, the sensors' last.
        deviations = np.exp(estimator.noise / 2)
        n_disturbances = len(model.disturbances)
        self._deviations = deviations[:n_disturbances]
        tables = self._scenario.sensors or ()
        first_of_sensors = len(deviations) - len(tables)
        of_sensors = deviations[first_of_sensors:].tolist()
        self._tables = []
        for table, deviation in zip(tables, of_sensors, strict=True):
            fitted = table.model_copy(update={"deviation": deviation})
            self._tables.append(fitted)
        self._seed = seed

    def run(
        self,
        theta: Parameters,
        n_samples: int,
        burn_in: int,
    ) -> SimulatedCost:
        """The mean cost of a rollout at θ, behind the filter that fits this plant.

        Args:
            theta: θ.
            n_samples: of the rollout.
            burn_in: the first of them, which do not count.
        """
        n = self._scenario.state_lower.size
        rollout = self.rollout(theta, n_samples, burn_in)
        if rollout is None:
            return _cost_of_a_failure(n)
        by_bound = rollout.penalties.mean(axis=1)
        mean = float(rollout.costs.mean() + by_bound.sum())
        mean_variance = rollout.variances.mean(axis=0)
        # Rounding may leave less than nothing of a state that is known.
        deviation = np.sqrt(np.maximum(mean_variance, 0.0))
        return SimulatedCost(mean, by_bound, deviation)

    def rollout(
        self,
        theta: Parameters,
        n_samples: int,
        burn_in: int,
        own_noise: Vector | None = None,
    ) -> FilteredRollout | None:
        """A rollout at θ; None where a QP fails or the loop runs away.

        Costs and penalties are those that the filter that fits the plant expects: one that takes
        the plant's noise for less than it is would expect too little.

        Args:
            theta: θ; its block `noise` does not count.
            n_samples: of the rollout.
            burn_in: the first of them, which are not returned.
            own_noise: η of the filter before the controller, (q,); None: the plant's.
        """
        n = self._scenario.state_lower.size
        estimator = self._filter
        law = self._law
        if own_noise is not None:
            law = self._own_law
            self._own_filter.noise = own_noise
        step = self._step
        nominal = self._model.nominal_disturbance
        rng = np.random.default_rng(self._seed)
        sensors = Sensors(self._tables)
        self._controller.parameters = _without_noise(theta)
        # Forget the last rollout; the filters then stand where the data end.
        law.reset()
        estimator.load_state_dict(self._state)
        if own_noise is not None:
            self._own_filter.load_state_dict(self._state)
        step.inputs["p"][:] = self._p
        s = estimator.estimate
        readings = self._measured(s)
        y = sensors.start(self._seed, readings)
        means = np.empty((n_samples, n))
        variances = np.empty((n_samples, n))
        costs = np.empty(n_samples)
        a = np.empty(0)
        for k in range(n_samples):
            # Else such readings would pass for none that are new, and the estimate for a state.
            if not np.isfinite([*s, *readings]).all():
                return None
            try:
                law.prepare()
                if own_noise is not None and k > 0:
                    estimator.predict(a)
                # The state of a sample is predicted before its readings are taken up.
                means[k] = estimator.estimate
                variances[k] = estimator.covariance.diagonal()
                a = law.feedback(y).action
                if own_noise is not None:
                    estimator.correct(y)
            except QpError:
                return None
            costs[k] = self._expected_cost(estimator.estimate, a)
            # The simulated plant itself, which nobody sees but through the sensors.
            draws = rng.standard_normal(nominal.size)
            step.inputs["s"][:] = s
            step.inputs["u"][:] = a
            step.inputs["d"][:] = nominal + self._deviations * draws
            step()
            s = step.part("x").copy()
            readings = self._measured(s)
            y = sensors.read(k + 1, readings)
        counted = slice(burn_in, None)
        penalties = expected_penalties_with_errors(
            self._scenario.state_penalty,
            means[counted],
            variances[counted],
            self._errors,
            self.n_normal,
        )
        rollout = FilteredRollout(means[counted], variances[counted], costs[counted], penalties)
        # Of a loop that ran away: NaN would compare as neither more nor less.
        if not all(np.isfinite(part).all() for part in rollout):
            return None
        return rollout

    def _expected_cost(self, estimate: Vector, a: Vector) -> float:
        """The stage cost as a rule under sensors knows it: at the estimate, without noise."""
        step = self._step
        step.inputs["s"][:] = estimate
        step.inputs["u"][:] = a
        step.inputs["d"][:] = self._model.nominal_disturbance
        step()
        return float(step.part("l")[0])

    def _measured(self, s: Vector) -> list[float]:
        """Values of the sensors' variables at a state (n,), (n_y,)."""
        readings = self._filter.expected_readings(s, self._p)
        values: list[float] = readings.tolist()
        return values


class BackOffsBehindFilter:
    """Searches back-offs δ (2n,) of the lower, then the upper state bounds on a fitted plant.

    Where θ has a block `margin`, κ (2n,) stands behind them: δ is then the mean back-off.

    Args:
        plant: the fitted plant.
        base: θ before its back-offs.
        distance: of the true bounds, (n,).
        reserve: back-offs of bounds that are not active, (2n,).
        mean_deviation: σ̄ of the estimate, (n,).
        settings: of `model-based`.
    """

    def __init__(
        self,
        plant: FittedPlant,
        base: Parameters,
        distance: Vector,
        reserve: Vector,
        mean_deviation: Vector,
        settings: Any,
    ) -> None:
        self._plant = plant
        self._base = base
        self._settings = settings
        self._reserve = reserve
        self._n_bounds = reserve.size
        self._mean_deviations = np.tile(mean_deviation, 2)
        most = settings.largest_back_off * distance
        largest_factors = np.full(reserve.size, settings.largest_margin)
        self._most = np.concatenate([most, most, largest_factors])
        self._known: dict[bytes, SimulatedCost] = {}

    def theta(self, delta: Vector) -> Parameters:
        """θ with its bounds backed off by δ, and with κ behind it."""
        base = self._base
        back_offs, factors = np.split(delta, [self._n_bounds])
        others = {}
        if factors.size:
            others["margin"] = factors
            # What does not follow the deviation; it may be less than nothing.
            back_offs = back_offs - factors * self._mean_deviations
        below, above = np.split(back_offs, 2)
        bounds = {
            "x_l": base["x_l"] + below,
            "x_u": base["x_u"] - above,
        }
        return base.replace(bounds | others)

    def cost(self, delta: Vector) -> SimulatedCost:
        """The rollout at δ; all meet the same noise."""
        # The search comes back to points, and a rollout is most of its time.
        key = delta.tobytes()
        if key not in self._known:
            settings = self._settings
            self._known[key] = self._plant.run(
                self.theta(delta),
                settings.simulated_samples,
                settings.burn_in,
            )
        return self._known[key]

    def best(self, delta: Vector, may_shrink: bool) -> Vector:
        """The cheapest δ, and κ behind it, that steps along the active bounds lead to.

        A bound is active where its penalty shows, or where it is backed off further than the
        reserve: that it costs nothing then may be the back-off's merit. Others keep theirs.

        Args:
            delta: present δ, (2n,) or, with κ, (4n,).
            may_shrink: whether a back-off may be less than it is, at any sample.
        """
        step = self._settings.back_off_step
        least = np.zeros_like(delta) if may_shrink else delta
        # A sweep that finds the place, and one that settles it.
        coarse = (step, step / 2)
        fine = (step / 4,)
        for steps in (coarse, fine):
            cost = self.cost(delta)
            shows = self._settings.least_penalty_share * abs(cost.mean)
            is_backed_off = delta[: self._n_bounds] > self._reserve
            active = np.flatnonzero((cost.penalties > shows) | is_backed_off)
            for i in active.tolist():
                delta = self._along(delta, i, least[i], steps)
                factor = self._n_bounds + i
                # At a larger κ the back-off behind a reading is less.
                if may_shrink and factor < delta.size:
                    delta = self._along(delta, factor, 0.0, steps)
        return delta

    def _unit(self, delta: Vector, i: int) -> float:
        """What steps of entry i are counted in."""
        # κ has no unit.
        if i >= self._n_bounds:
            return 1.0
        # What the filter is off in that state, which has two bounds.
        deviation = self.cost(delta).deviation
        return float(deviation[i % deviation.size])

    def _along(
        self,
        delta: Vector,
        i: int,
        least: float,
        steps: Sequence[float],
    ) -> Vector:
        """The cheapest δ by steps of one entry, taken until none is cheaper."""
        unit = self._unit(delta, i)
        most = self._most[i]
        while True:
            points = [delta]
            for step in steps:
                for sign in (-1.0, 1.0):
                    wanted = delta[i] + sign * step * unit
                    value = np.clip(wanted, least, most)
                    point = delta.copy()
                    point[i] = value
                    points.append(point)
            # Of equal costs the first counts, which is that of δ itself: the search ends.
            best = min(points, key=lambda point: self.cost(point).mean)
            if best is delta:
                return delta
            delta = best


def _without_noise(parameters: Parameters) -> Parameters:
    """θ without the block `noise`, which is its last."""
    if "noise" not in parameters.blocks:
        return parameters
    others = [block for block in parameters.blocks if block.name != "noise"]
    blocks = ThetaBlocks(tuple(others))
    theta = parameters.theta[: blocks.size]
    return Parameters(blocks, theta)


def _with_parameters(theta: Parameters, values: dict[str, float]) -> Parameters:
    """θ with those of some model parameters that it has set to values."""
    if "p" not in theta.blocks:
        return theta
    p = theta["p"]
    labels = theta.blocks.block("p").labels
    for name, value in values.items():
        if name in labels:
            index = labels.index(name)
            p[index] = value
    return theta.replace({"p": p})
