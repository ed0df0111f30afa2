"""`model-based` under sensors: filter, model and back-offs from readings that have gaps.

At each update the variances of the estimator's noises are those that fit the plant's innovations
best (`learning.innovations`), and the model's uncertain parameters what the filter then says. Both
make a plant: the controller's model at these parameters, with disturbances of these variances,
behind the same sensors. On that plant, behind the same filter, back-offs are searched. A sample of
it costs its stage cost at the estimate and the expectation of the next state's penalty.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from controllers.errors import QpError
from controllers.estimator import ExtendedKalmanFilter, OutputFeedback
from controllers.factories import nmpc
from controllers.functions import StackedFunction, define
from controllers.model import discretise
from controllers.problem import Problem
from controllers.theta import Parameters, ThetaBlocks
from cosim.core.protocols import Array, Vector
from cosim.core.scenario import Scenario
from cosim.core.sensors import Sensors
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State
from learning.errors import ConfigurationError
from learning.gaussian_penalty import expected_penalties_with_errors
from learning.innovations import fit_noise
from learning.step import update_without_fit


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
        if "noise" not in start.blocks:
            raise ConfigurationError(
                f"model-based under sensors moves the estimator's variances, and scenario "
                f"'{self.scenario.name}' has no estimator of kind 'ekf': leave out estimator.kind "
                "and noise=false"
            )
        self._filter = ExtendedKalmanFilter.from_scenario(self.scenario, differentiates=True)
        self._prior_mean = self._filter.noise
        self._plant = FittedPlant(self.scenario, start, self.configuration.normal_errors)
        problem = Problem.from_scenario(self.scenario)
        true_bounds = {"x_l": problem.state_lower, "x_u": problem.state_upper}
        self._base = start.replace(true_bounds)
        self._distance = problem.state_upper - problem.state_lower
        self._delays = np.array([sensor.delay for sensor in self.scenario.sensors or ()])
        # A ring of (y, a).
        n_columns = self._delays.size + problem.n_actions
        self._rows: Array = np.zeros((self.configuration.output_samples, n_columns))
        self._n_rows = 0  # since the last sample that is missing
        # Innovations of the sensors of each state, over their expected deviations.
        names = [quantity.name for quantity in problem.model.states]
        self._sensors_of_states = {}
        for i, sensor in enumerate(self.scenario.sensors or ()):
            if sensor.variable in names:
                self._sensors_of_states[names.index(sensor.variable)] = i
        self._errors: list[Array] = [np.empty(0) for _ in names]
        self._n_seen = 0  # samples whose innovations are among them
        self._count = 0
        settings = self.configuration
        self._due = max(settings.first_update, settings.least_samples)
        self.predicted_cost = float("nan")
        """What the fitted plant costs at θ, mean per sample; NaN before the first update."""

    def observe(self, transition: Transition) -> Update | None:
        """Keep a sample's readings; move θ when an update is due."""
        self.watch(transition)
        if self._count < self._due:
            return None
        settings = self.configuration
        self._due = self._count + min(self._count, settings.longest_interval)
        if self._n_rows < settings.least_samples:
            return None
        return self._update()

    def watch(self, transition: Transition) -> None:
        """Keep a sample's readings; θ stays."""
        assert transition.y is not None
        row = np.concatenate([transition.y, transition.a])
        self._rows[self._n_rows % len(self._rows)] = row
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
    def _data(self) -> tuple[Array, Array]:
        """Readings (M, n_y) and actions (M, m) of the latest samples, oldest first."""
        count = min(self._n_rows, len(self._rows))
        rows = self._rows[np.arange(self._n_rows - count, self._n_rows) % len(self._rows)]
        readings, actions = np.split(rows, [self._delays.size], axis=1)
        # What was read before the data begin says nothing of their states.
        for i, delay in enumerate(self._delays):
            readings[:delay, i] = np.nan
        return readings, actions

    def _update(self) -> Update:
        """Fit filter and model, search back-offs, and set θ where that costs less."""
        settings = self.configuration
        present = self.controller.parameters
        self._filter.noise = present["noise"]
        noise, innovations = fit_noise(
            self._filter,
            *self._data,
            self._prior_mean,
            settings.noise_prior,
            settings.fit_noise_rounds,
        )
        parameters = self._filter.parameters
        base = _with_parameters(self._base.replace({"noise": noise}), parameters)
        self._keep_errors(innovations)
        seed = int(self.rng.integers(2**63))
        self._plant.fit(self._filter, parameters, self._errors, seed)

        lower = present["x_l"] - self._base["x_l"]
        upper = self._base["x_u"] - present["x_u"]
        start = np.maximum(np.concatenate([lower, upper]), 0.0)
        search = BackOffsBehindFilter(self._plant, base, self._distance, settings)
        # Of few samples no back-off shrinks.
        least = start if self._n_rows < settings.shrink_samples else np.zeros_like(start)
        best = search.best(start, least)
        cost = search.cost(best)
        self.predicted_cost = cost.mean
        lost = not np.isfinite(cost.mean)
        if not lost:
            self.controller.theta = search.theta(best).theta
        end = self.controller.theta
        update = update_without_fit(present.blocks, present.theta, end, refused=lost)
        return update._replace(lost=lost)

    def _keep_errors(self, innovations: Array) -> None:
        """Keep those of the samples since the last update, as this fit has them."""
        new = innovations[-min(self._count - self._n_seen, len(innovations)) :]
        self._n_seen = self._count
        for state, sensor in self._sensors_of_states.items():
            arrived = new[~np.isnan(new[:, sensor]), sensor]
            kept = np.concatenate([self._errors[state], arrived])
            self._errors[state] = kept[-self.configuration.output_samples :]

    def state_dict(self) -> State:
        """Readings, schedule and prediction; the filter's variances are θ's."""
        return {
            "rows": self._rows,
            "n_rows": self._n_rows,
            "count": self._count,
            "due": self._due,
            "predicted_cost": self.predicted_cost,
            "n_seen": self._n_seen,
            **{f"errors{i}": errors for i, errors in enumerate(self._errors)},
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._rows = state["rows"]
        self._n_rows = state["n_rows"]
        self._count = state["count"]
        self._due = state["due"]
        self.predicted_cost = state["predicted_cost"]
        self._n_seen = state["n_seen"]
        self._errors = [state[f"errors{i}"] for i in range(len(self._errors))]


class SimulatedCost(NamedTuple):
    """What a rollout behind the filter costs.

    Attributes:
        mean: per sample; infinite where a QP failed.
        penalties: expected one of each bound in it, (2n,).
        deviation: of the predicted states' errors, (n,).
    """

    mean: float
    penalties: Vector
    deviation: Vector


class FittedPlant:
    """The controller's model as a plant behind the scenario's sensors, and its filter and NMPC.

    Args:
        scenario: model, sensors and penalty.
        parameters: θ, for its blocks.
        n_normal: weight of a normal law beside the errors that were seen.
    """

    def __init__(self, scenario: Scenario, parameters: Parameters, n_normal: float) -> None:
        problem = Problem.from_scenario(scenario)
        model = problem.model
        x, u, d, p = model.symbols()
        next_x = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
        results = {"x": next_x, "l": ca.SX(model.economic_cost(x, u, d, p))}
        self._step = StackedFunction(define("fitted", {"s": x, "u": u, "d": d, "p": p}, results))
        self._scenario = scenario
        self._n_normal = n_normal
        self._model = model
        # The filter's variances are set once for all rollouts: θ need not carry them.
        self._controller = nmpc(scenario, _without_noise(parameters))
        self._controller.compile()
        self._filter = ExtendedKalmanFilter.from_scenario(scenario)
        self._law = OutputFeedback(self._filter, self._controller)
        self._state: dict[str, Vector] = {}

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
        self._errors = errors
        self._filter.noise = estimator.noise
        state = estimator.state_dict()
        self._state = {name: state[name] for name in ("states", "covariance")}
        self._p = self._model.nominal_parameters
        for name, value in parameters.items():
            self._p[self._model.parameter_indices((name,))] = value
        deviations = np.exp(estimator.noise / 2)
        self._deviations = deviations[: len(self._model.disturbances)]
        tables = self._scenario.sensors or ()
        of_sensors = deviations[len(deviations) - len(tables) :].tolist()
        self._tables = []
        for table, deviation in zip(tables, of_sensors, strict=True):
            self._tables.append(table.model_copy(update={"deviation": deviation}))
        self._seed = seed

    def run(self, theta: Parameters, n_samples: int, burn_in: int) -> SimulatedCost:
        """The mean cost of a rollout at θ.

        Args:
            theta: θ.
            n_samples: of the rollout.
            burn_in: the first of them, which do not count.
        """
        n = self._scenario.state_lower.size
        law = self._law
        estimator = self._filter
        step = self._step
        nominal = self._model.nominal_disturbance
        rng = np.random.default_rng(self._seed)
        sensors = Sensors(self._tables)
        self._controller.parameters = _without_noise(theta)
        law.reset()
        estimator.load_state_dict(self._state)
        step.inputs["p"][:] = self._p
        s = estimator.estimate
        y = sensors.start(self._seed, self._measured(s))
        means = np.empty((n_samples, n))
        variances = np.empty((n_samples, n))
        costs = np.empty(n_samples)
        for k in range(n_samples):
            law.prepare()
            # The state of a sample is predicted before its readings are taken up.
            means[k] = estimator.estimate
            variances[k] = estimator.covariance.diagonal()
            try:
                a = law.feedback(y).action
            except QpError:
                return SimulatedCost(np.inf, np.full(2 * n, np.inf), np.zeros(n))
            step.inputs["s"][:] = estimator.estimate
            step.inputs["u"][:] = a
            step.inputs["d"][:] = nominal
            step()
            costs[k] = step.part("l")[0]
            step.inputs["s"][:] = s
            step.inputs["d"][:] = nominal + self._deviations * rng.standard_normal(nominal.size)
            step()
            s = step.part("x").copy()
            y = sensors.read(k + 1, self._measured(s))
        penalties = expected_penalties_with_errors(
            self._scenario.state_penalty,
            means[burn_in:],
            variances[burn_in:],
            self._errors,
            self._n_normal,
        )
        by_bound = penalties.mean(axis=1)
        mean = float(costs[burn_in:].mean() + by_bound.sum())
        if not np.isfinite(mean):
            mean = np.inf
        deviation = np.sqrt(variances[burn_in:].mean(axis=0))
        return SimulatedCost(mean, by_bound, deviation)

    def _measured(self, s: Vector) -> list[float]:
        """What the sensors' variables are at a state (n,), (n_y,)."""
        values: list[float] = self._filter.expected_readings(s, self._p).tolist()
        return values


class BackOffsBehindFilter:
    """Searches back-offs δ (2n,) of the lower, then the upper state bounds on a fitted plant.

    Args:
        plant: the fitted plant.
        base: θ before its back-offs.
        distance: of the true bounds, (n,).
        settings: of `model-based`.
    """

    def __init__(
        self,
        plant: FittedPlant,
        base: Parameters,
        distance: Vector,
        settings: Any,
    ) -> None:
        self._plant = plant
        self._base = base
        self._settings = settings
        self._most = np.tile(settings.largest_back_off * distance, 2)
        self._known: dict[bytes, SimulatedCost] = {}

    def theta(self, delta: Vector) -> Parameters:
        """θ with its bounds backed off by δ."""
        lower, upper = np.split(delta, 2)
        return self._base.replace(
            {"x_l": self._base["x_l"] + lower, "x_u": self._base["x_u"] - upper}
        )

    def cost(self, delta: Vector) -> SimulatedCost:
        """The rollout at δ; all meet the same noise."""
        key = delta.tobytes()
        if key not in self._known:
            settings = self._settings
            self._known[key] = self._plant.run(
                self.theta(delta), settings.simulated_samples, settings.burn_in
            )
        return self._known[key]

    def best(self, delta: Vector, least: Vector) -> Vector:
        """The cheapest δ that steps along the active bounds lead to.

        A bound is active where its penalty shows. Others keep their back-offs, a reserve.

        Args:
            delta: present δ, (2n,).
            least: least δ, (2n,).
        """
        step = self._settings.back_off_step
        # A sweep that finds the place, and one that settles it.
        for steps in ((step, step / 2), (step / 4,)):
            shows = self._settings.least_penalty_share * abs(self.cost(delta).mean)
            for i in np.flatnonzero(self.cost(delta).penalties > shows).tolist():
                delta = self._along(delta, i, least[i], steps)
        return delta

    def _along(self, delta: Vector, i: int, least: float, steps: Sequence[float]) -> Vector:
        """The cheapest δ by steps of one back-off, taken until none is cheaper."""
        unit = float(np.tile(self.cost(delta).deviation, 2)[i])
        while True:
            points = [delta]
            for step in steps:
                for sign in (-1.0, 1.0):
                    value = np.clip(delta[i] + sign * step * unit, least, self._most[i])
                    point = delta.copy()
                    point[i] = value
                    points.append(point)
            best = min(points, key=lambda point: self.cost(point).mean)
            if best is delta:
                return delta
            delta = best


def _without_noise(parameters: Parameters) -> Parameters:
    """θ without the block `noise`, which is its last."""
    if "noise" not in parameters.blocks:
        return parameters
    blocks = ThetaBlocks(tuple(block for block in parameters.blocks if block.name != "noise"))
    return Parameters(blocks, parameters.theta[: blocks.size])


def _with_parameters(theta: Parameters, values: dict[str, float]) -> Parameters:
    """θ with those of some model parameters that it has set to values."""
    if "p" not in theta.blocks:
        return theta
    p = theta["p"]
    labels = theta.blocks.block("p").labels
    for name, value in values.items():
        if name in labels:
            p[labels.index(name)] = value
    return theta.replace({"p": p})
